// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/elementwise.h"

#include <bit>
#include <cstdint>

// One source, one clone per instruction set, chosen at run time by the loader. The sanitizers instrument the resolver
// before they are ready, so their builds keep the baseline.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__)
#define VLA_CLONES __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define VLA_CLONES
#endif

namespace vla::kernels {
namespace {

/// The part of [0, count) that thread `ith` of `nth` works on.
struct Range {
  std::int64_t begin, end;
  Range(std::int64_t count, int ith, int nth) : begin(count * ith / nth), end(count * (ith + 1) / nth) {}
};

/// exp(x) to about one unit in the last place, written so that compilers vectorize it: x = n ln2 + r, a polynomial for
/// e^r (the Taylor series to the seventh power; |r| <= ln2 / 2), and n added to the exponent. Clamped where float32
/// ends.
inline float fast_exp(float x) {
  x = x < -87.0f ? -87.0f : (x > 88.0f ? 88.0f : x);
  const float n = __builtin_floorf(x * 1.44269504f + 0.5f);
  const float r = (x - n * 0.693359375f) - n * -2.12194440e-4f;  // ln2 in two parts, so that the subtraction is exact
  float p = 1.0f / 5040;
  p = p * r + 1.0f / 720;
  p = p * r + 1.0f / 120;
  p = p * r + 1.0f / 24;
  p = p * r + 1.0f / 6;
  p = p * r + 0.5f;
  p = p * r + 1.0f;
  p = p * r + 1.0f;
  return p * std::bit_cast<float>((static_cast<std::int32_t>(n) + 127) << 23);
}

VLA_CLONES void gelu_row(const float* x, float* y, std::int64_t count) {
  for (std::int64_t i = 0; i < count; ++i) {
    // 0.5 (1 + tanh(u)) = 1 / (1 + exp(-2u)): one exponential and one division.
    const float u = 0.7978845608f * (x[i] + 0.044715f * x[i] * x[i] * x[i]);
    y[i] = x[i] / (1.0f + fast_exp(-2.0f * u));
  }
}

void gelu_task(ggml_tensor* y, const ggml_tensor* x, int ith, int nth, void*) {
  const Range range(ggml_nelements(x), ith, nth);
  gelu_row(static_cast<const float*>(x->data) + range.begin, static_cast<float*>(y->data) + range.begin,
           range.end - range.begin);
}

VLA_CLONES void rotate_head(const float* x, const float* cosine, const float* sine, float* y, std::int64_t half) {
  for (std::int64_t i = 0; i < half; ++i) {
    y[i] = x[i] * cosine[i] - x[i + half] * sine[i];
    y[i + half] = x[i + half] * cosine[i] + x[i] * sine[i];
  }
}

void rotate_task(ggml_tensor* y, const ggml_tensor* x, const ggml_tensor* table, int ith, int nth, void*) {
  const std::int64_t d = x->ne[0], n_head = x->ne[1];
  const Range tokens(x->ne[2], ith, nth);
  for (std::int64_t token = tokens.begin; token < tokens.end; ++token) {
    const float* cosine = static_cast<const float*>(table->data) + token * d;
    for (std::int64_t head = 0; head < n_head; ++head) {
      const std::int64_t offset = (token * n_head + head) * d;
      rotate_head(static_cast<const float*>(x->data) + offset, cosine, cosine + d / 2,
                  static_cast<float*>(y->data) + offset, d / 2);
    }
  }
}

}  // namespace

Tensor gelu_tanh(Graph& g, Tensor x) {
  return ggml_map_custom1(g.context(), x.node(), gelu_task, GGML_N_TASKS_MAX, nullptr);
}

Tensor rotate_half(Graph& g, Tensor x, Tensor table) {
  return ggml_map_custom2(g.context(), x.node(), table.node(), rotate_task, GGML_N_TASKS_MAX, nullptr);
}

}  // namespace vla::kernels
