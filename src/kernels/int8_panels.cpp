// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/int8_panels.h"

namespace vla::kernels {
namespace {

constexpr std::int64_t kUnitStrips = 4;

template <class Panels>
std::size_t size_of(const MatrixDesc& desc) {
  return static_cast<std::size_t>(ceil_div(desc.d_out, Panels::kColumns * kUnitStrips) * kUnitStrips *
                                  Panels::strip_size(desc.d_in));
}

/// Transposes four bytes of four 2-bit codes each.
std::uint32_t transposed(std::uint32_t codes) {
  std::uint32_t moved = (codes ^ codes >> 6) & 0x00CC00CC;
  codes ^= moved ^ moved << 6;
  moved = (codes ^ codes >> 12) & 0x0000F0F0;
  return codes ^ moved ^ moved << 12;
}

}  // namespace

std::size_t BytePanels::packed_size(const MatrixDesc& desc) { return size_of<BytePanels>(desc); }

void BytePanels::pack(const MatrixDesc& desc, const std::byte* stored, std::byte* packed) {
  constexpr std::uint32_t kOffsets = kOffset * 0x01010101U;
  const std::int64_t d_in = desc.d_in, n_whole = d_in / 4 * 4;
  if (n_whole < quantized_depth(d_in) || desc.d_out % (kColumns * kUnitStrips) != 0)
    std::memset(packed, 0, packed_size(desc));
  for (std::int64_t first = 0; first < desc.d_out; first += kColumns, packed += strip_size(d_in)) {
    const std::int64_t n_column = min(desc.d_out - first, kColumns);
    const std::byte* const rows = stored + first * d_in;
    for (std::int64_t k = 0; k < n_whole; k += 4)
      for (std::int64_t n = 0; n < n_column; ++n) {
        std::uint32_t codes;
        std::memcpy(&codes, rows + n * d_in + k, sizeof(codes));
        codes ^= kOffsets;
        std::memcpy(packed + k / 4 * kLine + 4 * n, &codes, sizeof(codes));
      }
    for (std::int64_t k = n_whole; k < d_in; ++k)
      for (std::int64_t n = 0; n < n_column; ++n)
        packed[k / 4 * kLine + 4 * n + k % 4] = rows[n * d_in + k] ^ std::byte{kOffset};
  }
}

std::size_t Int4Panels::packed_size(const MatrixDesc& desc) { return size_of<Int4Panels>(desc); }

void Int4Panels::pack(const MatrixDesc& desc, const std::byte* stored, std::byte* packed) {
  const auto* block = reinterpret_cast<const Int4Block*>(stored);
  std::memset(packed, 0, packed_size(desc));
  for (std::int64_t n = 0; n < desc.d_out; ++n) {
    std::byte* const strip = packed + n / kColumns * strip_size(desc.d_in);
    std::byte* lines = strip + n % kColumns * 4;
    std::byte* step = strip + lines_size(desc.d_in) + n % kColumns;
    for (std::int64_t k = 0; k < desc.d_in; k += Int4Block::kElements, ++block, step += kColumns) {
      *step = std::byte{block->step};
      for (std::int64_t i = 0; i < Int4Block::kElements; i += 8, lines += kLine) {
        // Regroups codes: a byte of two neighbours becomes a byte of two codes that are four apart.
        std::uint32_t two;
        std::memcpy(&two, block->codes.data() + i / 2, sizeof(two));
        const std::uint32_t low = two & 0x0f0f0f0f, high = two >> 4 & 0x0f0f0f0f;
        const auto spread = [](std::uint32_t even, std::uint32_t odd) {
          return (even & 0xff) | (odd & 0xff) << 8 | (even & 0xff00) << 8 | (odd & 0xff00) << 16;
        };
        const std::uint32_t line = spread(low, high) | spread(low >> 16, high >> 16) << 4;
        std::memcpy(lines, &line, sizeof(line));
      }
    }
  }
}

std::size_t TernaryPanels::packed_size(const MatrixDesc& desc) { return size_of<TernaryPanels>(desc); }

void TernaryPanels::pack(const MatrixDesc& desc, const std::byte* stored, std::byte* packed) {
  const std::int64_t row = desc.d_in / 4;  // bytes
  std::memset(packed, 0, packed_size(desc));
  for (std::int64_t n = 0; n < desc.d_out; ++n, stored += row) {
    std::byte* to = packed + n / kColumns * strip_size(desc.d_in) + n % kColumns * 4;
    for (std::int64_t i = 0; i < row; i += 4, to += kLine) {
      std::uint32_t codes = 0;
      std::memcpy(&codes, stored + i, static_cast<std::size_t>(min(4, row - i)));
      codes = transposed(codes);
      std::memcpy(to, &codes, sizeof(codes));
    }
  }
}

}  // namespace vla::kernels
