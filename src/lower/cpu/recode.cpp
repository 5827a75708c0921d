// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/recode.h"

#include <cassert>
#include <cstring>

#include "kernels/quantize_weights.h"

namespace vla::lower {
namespace {

void round_to_bf16(DType type, const std::byte* stored, std::int64_t n, std::byte* to) {
  for (std::int64_t i = 0; i < n; ++i) {
    const std::uint16_t rounded = to_bf16(kernels::stored_number(type, stored, i));
    std::memcpy(to + static_cast<std::int64_t>(sizeof(rounded)) * i, &rounded, sizeof(rounded));
  }
}

void widen(const std::byte* codes, std::int64_t n, std::int64_t group, const float* scales, std::byte* to) {
  for (std::int64_t i = 0; i < n; ++i) {
    const float value = static_cast<float>(std::to_integer<std::int8_t>(codes[i])) * scales[i / group];
    std::memcpy(to + static_cast<std::int64_t>(sizeof(value)) * i, &value, sizeof(value));
  }
}

}  // namespace

const std::byte* Recode::operator()(const std::byte* from, const float* from_scales, std::int64_t count, Room& room,
                                    float* scales) const {
  if (!changes()) return from;
  std::byte* const to = room.take(room_for(count));
  if (stored.type == DType::i8 && wanted.type == DType::f32) {
    widen(from, count, stored.group, from_scales, to);
  } else if (wanted.type == DType::bf16) {
    round_to_bf16(stored.type, from, count, to);
  } else {
    assert(is_float(stored.type) && wanted.type == DType::i8);
    auto* const group = reinterpret_cast<float*>(to + aligned(dtype_size(wanted.type, count)));
    kernels::quantize_weights(stored.type, from, wanted.group, count / wanted.group, to, scales, group);
  }
  return to;
}

}  // namespace vla::lower
