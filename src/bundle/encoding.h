// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

namespace vla {

/// The type of a stored element. Rows of ternary ones are whole bytes: element 4 i + j of a row is the code in bits 2 j
/// and 2 j + 1 of byte i, and codes 0, 1 and 2 stand for -1, 0 and 1. Rows of int4 ones are blocks (Int4Block). A
/// bundle's tensors are of the other dtypes: there the bytes of a ternary or int4 matrix are i8.
enum class DType { f32, f16, bf16, i32, i8, f64, ternary, int4 };

/// 64 elements of a row of an int4 matrix: a step from 0 to 17, then codes from 1 to 15, those of elements 2 i and
/// 2 i + 1 in the lower and the higher bits of byte i. (code - 8) * step is an integer of at most 119, which counts
/// as an int8 code: so sums of products are integers as well. The largest step is the one whose product with the
/// largest code fits into a byte without sign. A row is whole blocks: behind its end, elements of the last are zeros.
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

/// Bytes of n elements one behind the other; of int4 ones, of a row of them.
inline std::size_t dtype_size(DType type, std::int64_t n) {
  if (type == DType::int4) return static_cast<std::size_t>(Int4Block::n_of(n)) * sizeof(Int4Block);
  return static_cast<std::size_t>(n * dtype_bits(type) + 7) / 8;
}

/// Whether an element is a value of the network, and no code that a scale belongs to.
constexpr bool is_float(DType type) { return type == DType::f32 || type == DType::f16 || type == DType::bf16; }

/// How a parameter is stored, or lies in memory: its elements, and a float32 scale for every `group` of them in the
/// order of the rows, which makes values of codes. 0: elements are values, without a scale.
struct Encoding {
  DType type = DType::f32;
  std::int64_t group = 0;

  /// Bytes of so many elements, whole rows of them.
  std::size_t size(std::int64_t count) const {
    if (type != DType::int4) return dtype_size(type, count);
    return static_cast<std::size_t>(count / group) * dtype_size(type, group);
  }
  /// The number of scales of a matrix with so many elements.
  std::int64_t n_scale(std::int64_t count) const { return group > 0 ? count / group : 0; }
  bool operator==(const Encoding&) const = default;
};

/// The values of n int8 or int4 codes, whole groups of them: code * scale.
void widen_codes(const Encoding& encoding, const std::byte* codes, const float* scales, std::int64_t n, float* to);

}  // namespace vla
