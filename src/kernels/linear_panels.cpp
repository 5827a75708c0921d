// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/linear_panels.h"

namespace vla::kernels {
namespace {

/// Copies words of a row to lines of a block; a half word may remain.
template <int kWord, int kLine>
void put_words(const std::byte* from, std::int64_t size, std::byte* to) {
  for (; size >= kWord; size -= kWord, from += kWord, to += kLine) std::memcpy(to, from, kWord);
  if (size > 0) std::memcpy(to, from, static_cast<std::size_t>(size));
}

/// Copies n elements of a row to a column of a block.
void put(DType type, const std::byte* numbers, std::int64_t n, std::byte* column) {
  if (type == DType::f16) return put_words<2, 32>(numbers, 2 * n, column);
  put_words<4, 64>(numbers, n * number_size(type), column);
}

}  // namespace

template <int kColumns>
std::size_t Panels<kColumns>::packed_size(const MatrixDesc& desc) {
  return static_cast<std::size_t>(ceil_div(desc.d_out, kColumns) * size(desc.type, round_up(desc.d_in, kPanelDepth)));
}

template <int kColumns>
void Panels<kColumns>::pack(const MatrixDesc& desc, const std::byte* stored, std::byte* packed) {
  const std::int64_t row = desc.d_in * number_size(desc.type), depth = block_depth(desc.type);
  const std::int64_t panel = size(desc.type, round_up(desc.d_in, kPanelDepth));
  for (std::int64_t first = 0; first < desc.d_out; first += kColumns, packed += panel) {
    const std::int64_t n_column = min(desc.d_out - first, kColumns);
    if (n_column < kColumns || desc.d_in % kPanelDepth != 0) std::memset(packed, 0, static_cast<std::size_t>(panel));
    for (std::int64_t k = 0; k < desc.d_in; k += depth)
      for (std::int64_t n = 0; n < n_column; ++n)
        put(desc.type, stored + (first + n) * row + k * number_size(desc.type), min(depth, desc.d_in - k),
            packed + place(desc.type, k, n));
  }
}

template struct Panels<16>;
template struct Panels<32>;

}  // namespace vla::kernels
