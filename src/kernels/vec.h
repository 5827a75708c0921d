// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <cstdint>
#include <cstring>

/// Kernels are templates over one of the types below. Each type is used only in files compiled for its instructions.
/// Everything that kernels call is forced inline: the linker could merge an out-of-line function with a copy that was
/// compiled for a better machine.
#define VLA_INLINE inline __attribute__((always_inline))
#define VLA_LAMBDA __attribute__((always_inline))  // after a lambda's parameters

namespace vla::kernels {

/// `W` lanes in the compiler's vector extension, whose operators provide arithmetic, comparisons and `mask ? a : b`.
template <int W>
struct Lanes {
  static constexpr int width = W;
  typedef float Float __attribute__((vector_size(4 * W)));
  typedef std::int32_t Int __attribute__((vector_size(4 * W)));

  static VLA_INLINE Float set(float x) { return x - Float{}; }
  static VLA_INLINE Float load(const float* p) {
    Float x;
    std::memcpy(&x, p, sizeof(x));
    return x;
  }
  static VLA_INLINE void store(float* p, Float x) { std::memcpy(p, &x, sizeof(x)); }
  /// Loads the first `n` lanes, 0 <= n <= W; the others are zeros.
  static VLA_INLINE Float load_part(const float* p, int n) {
    Float x = {};
    std::memcpy(&x, p, static_cast<std::size_t>(n) * sizeof(float));
    return x;
  }
  static VLA_INLINE void store_part(float* p, Float x, int n) {
    std::memcpy(p, &x, static_cast<std::size_t>(n) * sizeof(float));
  }
  static VLA_INLINE Float divide(Float a, Float b) { return a / b; }
  static VLA_INLINE float sum(Float x) {
    float all[W];
    store(all, x);
    for (int step = W / 2; step > 0; step /= 2)
      for (int i = 0; i < step; ++i) all[i] += all[i + step];
    return all[0];
  }
};

/// Loads a vector from p, where `left` elements remain; lanes after them are zeros.
template <class V>
VLA_INLINE typename V::Float load(const float* p, std::int64_t left) {
  return left >= V::width ? V::load(p) : V::load_part(p, static_cast<int>(left));
}
template <class V>
VLA_INLINE void store(float* p, typename V::Float x, std::int64_t left) {
  left >= V::width ? V::store(p, x) : V::store_part(p, x, static_cast<int>(left));
}

/// Transposes W vectors of W lanes: each round interleaves vectors that are W / 2 apart.
template <class V>
VLA_INLINE void transpose(typename V::Float (&x)[V::width]) {
  constexpr int kHalf = V::width / 2;
#pragma GCC unroll 4
  for (int size = V::width; size > 1; size /= 2) {
    typename V::Float y[V::width];
#pragma GCC unroll 8
    for (int i = 0; i < kHalf; ++i) {
      y[2 * i] = V::interleave_low(x[i], x[i + kHalf]);
      y[2 * i + 1] = V::interleave_high(x[i], x[i + kHalf]);
    }
#pragma GCC unroll 16
    for (int i = 0; i < V::width; ++i) x[i] = y[i];
  }
}

/// Reduces each x[i] to lane i of the result by `join` (a sum or a maximum). The order of the elements is unspecified.
template <class V, class Join>
VLA_INLINE typename V::Float across(typename V::Float (&x)[V::width], Join join) {
#pragma GCC unroll 4
  for (int n = V::width / 2; n > 0; n /= 2)
#pragma GCC unroll 8
    for (int i = 0; i < n; ++i) x[i] = join(V::interleave_low(x[i], x[i + n]), V::interleave_high(x[i], x[i + n]));
  return x[0];
}

}  // namespace vla::kernels
