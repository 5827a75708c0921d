// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "kernels/vec.h"

/// How sizes are cut into pieces and filled up.
namespace vla::kernels {

constexpr VLA_INLINE std::int64_t least(std::int64_t a, std::int64_t b) { return a < b ? a : b; }
constexpr VLA_INLINE std::int64_t pieces(std::int64_t n, std::int64_t size) { return (n + size - 1) / size; }
constexpr VLA_INLINE std::int64_t round_up(std::int64_t n, std::int64_t unit) { return pieces(n, unit) * unit; }
/// n cut into as few equal pieces as `most` allows, each a multiple of `unit`.
constexpr VLA_INLINE std::int64_t even_piece(std::int64_t n, std::int64_t most, std::int64_t unit) {
  return n == 0 ? unit : round_up(pieces(n, pieces(n, most)), unit);
}

}  // namespace vla::kernels
