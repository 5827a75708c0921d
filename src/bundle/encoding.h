// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

namespace vla {

/// What an element is stored as. Rows of ternary ones are whole bytes: element 4 i + j of a row is the code in bits 2 j
/// and 2 j + 1 of byte i, and codes 0, 1 and 2 stand for -1, 0 and 1. A bundle's tensors are of the other dtypes: there
/// the bytes of a ternary matrix are i8.
enum class DType { f32, f16, bf16, i32, i8, f64, ternary };

const char* dtype_name(DType type);
int dtype_bits(DType type);

/// Bytes of n elements one behind the other.
inline std::size_t dtype_size(DType type, std::int64_t n) {
  return static_cast<std::size_t>(n * dtype_bits(type) + 7) / 8;
}

/// Whether an element is a value of the network, and no code that a scale belongs to.
constexpr bool is_float(DType type) { return type == DType::f32 || type == DType::f16 || type == DType::bf16; }

/// How a parameter is stored, or lies in memory: its elements, and a float32 scale for every `group` of them in the
/// order of the rows, which makes values of codes. 0: elements are values, without a scale.
struct Encoding {
  DType type = DType::f32;
  std::int64_t group = 0;

  /// Of a matrix with so many elements.
  std::int64_t n_scale(std::int64_t count) const { return group > 0 ? count / group : 0; }
  bool operator==(const Encoding&) const = default;
};

}  // namespace vla
