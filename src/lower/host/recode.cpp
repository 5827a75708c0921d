// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/host/recode.h"

#include <cassert>
#include <cstring>

#include "kernels/quantize_weights.h"

namespace vla::lower {
namespace {

void widen(DType type, const std::byte* stored, std::int64_t n, float* to) {
  for (std::int64_t i = 0; i < n; ++i) to[i] = kernels::stored_number(type, stored, i);
}

void round_to_bf16(DType type, const std::byte* stored, std::int64_t n, std::byte* to) {
  for (std::int64_t i = 0; i < n; ++i) {
    const std::uint16_t rounded = to_bf16(kernels::stored_number(type, stored, i));
    std::memcpy(to + static_cast<std::int64_t>(sizeof(rounded)) * i, &rounded, sizeof(rounded));
  }
}

}  // namespace

const std::byte* Recode::operator()(const std::byte* from, const float* from_scales, std::int64_t count,
                                    ReadBuffer& buffer, float* scales) const {
  if (!changes()) return from;
  std::byte* const to = buffer.take(buffer_size(count));
  if (!is_float(stored.type)) {
    assert(stored.group > 0 && wanted.type == DType::f32);
    widen_codes(stored, from, from_scales, count, reinterpret_cast<float*>(to));
  } else if (wanted.type == DType::f32) {
    widen(stored.type, from, count, reinterpret_cast<float*>(to));
  } else if (wanted.type == DType::bf16) {
    round_to_bf16(stored.type, from, count, to);
  } else {
    assert(wanted.type == DType::i8 || wanted.type == DType::int4);
    auto* const row = reinterpret_cast<float*>(to + aligned(wanted.size(count)));
    const std::int64_t d_in = wanted.group, d_out = count / d_in;
    if (wanted.type == DType::i8)
      kernels::quantize_weights(stored.type, from, d_in, d_out, to, scales, row);
    else
      kernels::quantize_weights(stored.type, from, d_in, d_out, reinterpret_cast<Int4Block*>(to), scales, row);
  }
  return to;
}

}  // namespace vla::lower
