// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/elementwise.h"

#include <bit>
#include <cstdint>
#include <cstring>

#include "kernels/cpu_kernels.h"
#include "kernels/custom.h"

// One source, one clone per instruction set, chosen at run time by the loader. The sanitizers instrument the resolver
// before they are ready, so their builds keep the baseline.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__) && \
    !defined(__SANITIZE_THREAD__)
#define VLA_CLONES __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define VLA_CLONES
#endif

namespace vla::kernels {
namespace {

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

struct MapParams {
  CpuKernels::Map map;
};

VLA_CLONES void gelu_row(const float* x, float* y, std::int64_t count) {
  for (std::int64_t i = 0; i < count; ++i) {
    // 0.5 (1 + tanh(u)) = 1 / (1 + exp(-2u)): one exponential and one division.
    const float u = 0.7978845608f * (x[i] + 0.044715f * x[i] * x[i] * x[i]);
    y[i] = x[i] / (1.0f + fast_exp(-2.0f * u));
  }
}

VLA_CLONES void relu_row(const float* x, float* y, std::int64_t count) {
  for (std::int64_t i = 0; i < count; ++i) y[i] = x[i] < 0.0f ? 0.0f : x[i];
}

void map_task(ggml_tensor* y, int ith, int nth, void* user) {
  const Range range(ggml_nelements(y), ith, nth);
  static_cast<const MapParams*>(user)->map(values(y->src[0]) + range.begin, static_cast<float*>(y->data) + range.begin,
                                           range.end - range.begin);
}

Tensor map(Graph& g, Tensor x, CpuKernels::Map row) {
  return custom(g, {x.dim(0), x.dim(1), x.dim(2), x.dim(3)}, {contiguous(g, x)}, map_task, keep(g, MapParams{row}));
}

VLA_CLONES void rotate_head(const float* x, const float* cosine, const float* sine, float* y, std::int64_t half) {
  for (std::int64_t i = 0; i < half; ++i) {
    y[i] = x[i] * cosine[i] - x[i + half] * sine[i];
    y[i + half] = x[i + half] * cosine[i] + x[i] * sine[i];
  }
}

struct RotateParams {
  decltype(CpuKernels::rotate_half) rotate;
};

void rotate_task(ggml_tensor* y, int ith, int nth, void* user) {
  const ggml_tensor *x = y->src[0], *table = y->src[1];
  const std::int64_t d = x->ne[0];
  const Range rows(ggml_nrows(x), ith, nth);
  for (std::int64_t row = rows.begin; row < rows.end; ++row) {
    const float* cosine = values(table) + row / x->ne[1] % x->ne[2] * d;
    static_cast<const RotateParams*>(user)->rotate(row_of(x, row), cosine, cosine + d / 2,
                                                   static_cast<float*>(y->data) + row * d, d / 2);
  }
}

/// Numbers [begin, end) of what `part` is in the whole, where it starts at `place`.
void copy_part(const ggml_tensor* part, std::int64_t place, Range whole, float* out) {
  const std::int64_t begin = std::max(whole.begin, place), end = std::min(whole.end, place + ggml_nelements(part));
  if (begin < end)
    std::memcpy(out + begin, values(part) + begin - place, static_cast<std::size_t>(end - begin) * sizeof(float));
}

void join_task(ggml_tensor* y, int ith, int nth, void*) {
  const Range range(ggml_nelements(y), ith, nth);
  copy_part(y->src[0], 0, range, static_cast<float*>(y->data));
  copy_part(y->src[1], ggml_nelements(y->src[0]), range, static_cast<float*>(y->data));
}

}  // namespace

Tensor gelu_tanh(Graph& g, Tensor x) {
  const CpuKernels* kernels = cpu_kernels(g.isa());
  return map(g, x, kernels != nullptr ? kernels->gelu_tanh : gelu_row);
}

Tensor gelu_erf(Graph& g, Tensor x) {
  const CpuKernels* kernels = cpu_kernels(g.isa());
  return kernels != nullptr ? map(g, x, kernels->gelu_erf) : Tensor(ggml_gelu_erf(g.context(), x.node()));
}

Tensor relu(Graph& g, Tensor x) {
  const CpuKernels* kernels = cpu_kernels(g.isa());
  return map(g, x, kernels != nullptr ? kernels->relu : relu_row);
}

Tensor contiguous(Graph& g, Tensor x) {
  return ggml_is_contiguous(x.node()) ? x : Tensor(ggml_cont(g.context(), x.node()));
}

Tensor rotate_half(Graph& g, Tensor x, Tensor table) {
  const CpuKernels* kernels = cpu_kernels(g.isa());
  return custom(g, {x.dim(0), x.dim(1), x.dim(2), x.dim(3)}, {x, table}, rotate_task,
                keep(g, RotateParams{kernels != nullptr ? kernels->rotate_half : rotate_head}));
}

Tensor join(Graph& g, Tensor first, Tensor second, int dim) {
  const bool last = ggml_n_dims(first.node()) <= dim + 1;
  if (!last || !ggml_is_contiguous(first.node()) || !ggml_is_contiguous(second.node()))
    return ggml_concat(g.context(), first.node(), second.node(), dim);
  std::int64_t n[] = {first.dim(0), first.dim(1), first.dim(2), first.dim(3)};
  n[dim] += second.dim(dim);
  return custom(g, {n[0], n[1], n[2], n[3]}, {first, second}, join_task, nullptr);
}

}  // namespace vla::kernels
