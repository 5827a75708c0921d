// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <cstring>

#include "base/bf16.h"
#include "bundle/bundle.h"
#include "kernels/vec.h"

/// The element types of stored matrices.
namespace vla::kernels {

VLA_INLINE float from_f16(std::uint16_t x) {
  const std::uint32_t sign = std::uint32_t{x & 0x8000U} << 16, exponent = x >> 10 & 31U, fraction = x & 1023U;
  if (exponent == 31) return std::bit_cast<float>(sign | 0x7f800000U | fraction << 13);
  if (exponent != 0) return std::bit_cast<float>(sign | (exponent + 112) << 23 | fraction << 13);
  const float small = static_cast<float>(fraction) * 0x1p-24f;
  return sign != 0 ? -small : small;
}

/// Bytes of a stored element.
constexpr VLA_INLINE std::int64_t number_size(DType type) { return type == DType::f32 ? 4 : 2; }

/// Element i of a stored matrix.
VLA_INLINE float stored_number(DType type, const std::byte* stored, std::int64_t i) {
  if (type == DType::f32) {
    float x;
    std::memcpy(&x, stored + 4 * i, sizeof(x));
    return x;
  }
  std::uint16_t x;
  std::memcpy(&x, stored + 2 * i, sizeof(x));
  return type == DType::bf16 ? from_bf16(x) : from_f16(x);
}

}  // namespace vla::kernels
