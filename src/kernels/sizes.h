// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "kernels/vec.h"

/// How sizes are split into blocks and rounded.
namespace vla::kernels {

constexpr VLA_INLINE std::int64_t min(std::int64_t a, std::int64_t b) { return a < b ? a : b; }
constexpr VLA_INLINE std::int64_t max(std::int64_t a, std::int64_t b) { return a > b ? a : b; }
constexpr VLA_INLINE std::int64_t ceil_div(std::int64_t n, std::int64_t size) { return (n + size - 1) / size; }
constexpr VLA_INLINE std::int64_t round_up(std::int64_t n, std::int64_t unit) { return ceil_div(n, unit) * unit; }
/// The block size that splits n into equal blocks, as few as `max` allows, each a multiple of `unit`.
constexpr VLA_INLINE std::int64_t even_block(std::int64_t n, std::int64_t max, std::int64_t unit) {
  return n == 0 ? unit : round_up(ceil_div(n, ceil_div(n, max)), unit);
}

}  // namespace vla::kernels
