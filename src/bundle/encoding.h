// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

namespace vla {

/// The type of a stored element. A ternary row is whole bytes: bits 2 j and 2 j + 1 of byte i hold the code of element
/// 4 i + j, and codes 0, 1 and 2 mean -1, 0 and 1. An int4 row is a sequence of Int4Block. In a bundle both are stored
/// as tensors of i8.
enum class DType { f32, f16, bf16, i32, i8, f64, ternary, int4 };

/// 64 elements of an int4 row: a step from 0 to 17, then codes from 1 to 15. Byte i has the code of element 2 i in its
/// lower four bits and that of 2 i + 1 in its higher four. An element is (code - 8) * step, an integer of at most 119
/// that counts as an int8 code, so sums of products stay integers. The step is at most 17 so that step times the
/// largest code fits into an unsigned byte. A row is padded with zeros to whole blocks.
struct Int4Block {
  static constexpr std::int64_t kElements = 64;
  static constexpr int kMaxStep = 17, kZero = 8, kMost = 7;

  std::uint8_t step;
  std::array<std::uint8_t, kElements / 2> codes;

  /// Blocks of a row.
  static constexpr std::int64_t n_of(std::int64_t d_in) { return (d_in + kElements - 1) / kElements; }

  int operator[](std::int64_t i) const {
    return ((codes[static_cast<std::size_t>(i / 2)] >> i % 2 * 4 & 15) - kZero) * step;
  }
};
static_assert(sizeof(Int4Block) == 33 && alignof(Int4Block) == 1);

const char* dtype_name(DType type);
int dtype_bits(DType type);

/// Bytes of n consecutive elements; for int4 of one row of n elements.
inline std::size_t dtype_size(DType type, std::int64_t n) {
  if (type == DType::int4) return static_cast<std::size_t>(Int4Block::n_of(n)) * sizeof(Int4Block);
  return static_cast<std::size_t>(n * dtype_bits(type) + 7) / 8;
}

/// Whether an element is a value of the network rather than a code that needs a scale.
constexpr bool is_float(DType type) { return type == DType::f32 || type == DType::f16 || type == DType::bf16; }

/// How a parameter is stored in a file or in memory: the dtype of its elements, and one float32 scale for every `group`
/// of them in row order; an element is its code times the scale. `group` is 0 if there are no scales.
struct Encoding {
  DType type = DType::f32;
  std::int64_t group = 0;

  /// Bytes of that many elements; they must be whole rows.
  std::size_t size(std::int64_t count) const {
    if (type != DType::int4) return dtype_size(type, count);
    return static_cast<std::size_t>(count / group) * dtype_size(type, group);
  }
  /// How many scales a matrix of that many elements has.
  std::int64_t n_scale(std::int64_t count) const { return group > 0 ? count / group : 0; }
  bool operator==(const Encoding&) const = default;
};

/// Decodes n int8 or int4 codes, a multiple of the group: code * scale.
void widen_codes(const Encoding& encoding, const std::byte* codes, const float* scales, std::int64_t n, float* to);

}  // namespace vla
