// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <cmath>
#include <cstring>
#include <span>
#include <vector>

#include "kernels/numbers.h"

namespace vla::test {

/// -1, 0 and 1 as a ternary matrix is stored, whose rows are whole bytes.
inline std::vector<std::byte> store_ternary(const std::vector<float>& values) {
  std::vector<std::byte> out(values.size() / 4);
  for (std::size_t i = 0; i < 4 * out.size(); ++i)
    out[i / 4] |= static_cast<std::byte>(static_cast<int>(values[i] + 1) << 2 * (i % 4));
  return out;
}

/// Whole numbers as a matrix of int8 is stored.
inline std::vector<std::byte> store_int8(const std::vector<float>& values) {
  std::vector<std::byte> out;
  for (const float value : values) out.push_back(static_cast<std::byte>(static_cast<signed char>(value)));
  return out;
}

/// Rows of codes from -7 to 7, and a step for each of a row's blocks, as int4 is stored.
inline std::vector<std::byte> store_int4(const std::vector<int>& codes, std::int64_t d_in,
                                         const std::vector<int>& steps) {
  std::vector<Int4Block> blocks;
  for (const int step : steps) {
    blocks.push_back({.step = static_cast<std::uint8_t>(step), .codes = {}});
    blocks.back().codes.fill(0x88);
  }
  for (std::size_t i = 0; i < codes.size(); ++i) {
    const std::int64_t row = static_cast<std::int64_t>(i) / d_in, k = static_cast<std::int64_t>(i) % d_in;
    Int4Block& block = blocks[static_cast<std::size_t>(row * Int4Block::n_of(d_in) + k / Int4Block::kElements)];
    block.codes[static_cast<std::size_t>(k % Int4Block::kElements / 2)] ^=
        static_cast<std::uint8_t>(((codes[i] + 8) ^ 8) << k % 2 * 4);
  }
  const auto bytes = std::as_bytes(std::span(blocks));
  return {bytes.begin(), bytes.end()};
}

/// Values in a storage type, and what the type made of them.
inline std::vector<std::byte> store_as(DType type, std::vector<float>& values) {
  if (type == DType::ternary) return store_ternary(values);
  std::vector<std::byte> out(values.size() * (type == DType::f32 ? 4 : 2));
  for (std::size_t i = 0; i < values.size(); ++i) {
    if (type == DType::f32) {
      std::memcpy(&out[4 * i], &values[i], 4);
      continue;
    }
    std::uint16_t bits = to_bf16(values[i]);
    if (type == DType::f16) {  // eleven bits, exponents from the smallest normal up
      const float clear = std::abs(values[i]) < 0x1p-14f ? 0x1p-14f : values[i];
      const auto word = std::bit_cast<std::uint32_t>(clear);
      bits = static_cast<std::uint16_t>((word >> 16 & 0x8000U) | (((word >> 23 & 255U) - 112U) << 10) |
                                        (word >> 13 & 1023U));
    }
    std::memcpy(&out[2 * i], &bits, 2);
    values[i] = kernels::stored_number(type, out.data(), static_cast<std::int64_t>(i));
  }
  return out;
}

}  // namespace vla::test
