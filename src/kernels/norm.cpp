// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/norm.h"

#include "kernels/custom.h"

namespace vla::kernels {
namespace {

void norm_task(ggml_tensor* y, int ith, int nth, void* user) {
  const auto& params = *static_cast<const NormParams*>(user);
  const ggml_tensor* x = y->src[0];
  const float* weight = values(y->src[1]);
  const float* bias = y->src[2] != nullptr ? values(y->src[2]) : nullptr;
  const Range rows(ggml_nrows(x), ith, nth);
  for (std::int64_t row = rows.begin; row < rows.end; ++row)
    params.norm(row_of(x, row), weight, bias, params.eps, static_cast<float*>(y->data) + row * x->ne[0], x->ne[0]);
}

Tensor norm(Graph& g, CpuKernels::Norm kernel, Tensor x, Tensor weight, Tensor bias, float eps) {
  NormParams* params = keep(g, NormParams{kernel, eps});
  const Tensor y = custom(g, {x.dim(0), x.dim(1), x.dim(2), x.dim(3)}, {x, weight, bias}, norm_task, params);
  g.note(y, params);
  return y;
}

/// The reference: ggml's operations, one after the other.
Tensor scale_and_shift(Graph& g, ggml_tensor* normalized, Tensor weight, Tensor bias) {
  ggml_tensor* scaled = ggml_mul(g.context(), normalized, weight.node());
  return bias ? ggml_add(g.context(), scaled, bias.node()) : scaled;
}

}  // namespace

Tensor layer_norm(Graph& g, Tensor x, Tensor weight, Tensor bias, float eps) {
  const CpuKernels* kernels = cpu_kernels(g.isa());
  if (kernels == nullptr) return scale_and_shift(g, ggml_norm(g.context(), x.node(), eps), weight, bias);
  return norm(g, kernels->layer_norm, x, weight, bias, eps);
}

Tensor rms_norm(Graph& g, Tensor x, Tensor weight, Tensor bias, float eps) {
  const CpuKernels* kernels = cpu_kernels(g.isa());
  if (kernels == nullptr) return scale_and_shift(g, ggml_rms_norm(g.context(), x.node(), eps), weight, bias);
  return norm(g, kernels->rms_norm, x, weight, bias, eps);
}

}  // namespace vla::kernels
