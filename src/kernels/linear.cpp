// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/linear.h"

#include "kernels/custom.h"
#include "kernels/elementwise.h"
#include "kernels/linear_kernel.h"
#include "kernels/norm.h"
#include "kernels/numbers.h"

namespace vla::kernels {
namespace {

/// What a node keeps: the job without its addresses, which are known when it runs. The node's sources are x, all
/// weights, the biases that there are, the residual, and weight and bias of the norm.
struct LinearNode {
  const LinearKernel* kernel;
  Scratch* scratch;
  LinearJob job;
  Turns turns;
  bool has_bias[LinearJob::kMaxPart], has_residual, has_norm_bias;
};

void linear_task(ggml_tensor* y, int ith, int nth, void* user) {
  auto& node = *static_cast<LinearNode*>(user);
  LinearJob job = node.job;
  job.turns = &node.turns;
  job.x = static_cast<const std::byte*>(y->src[0]->data);
  auto* out = static_cast<std::byte*>(y->data);
  int i_bias = 1 + job.n_part;
  for (int i = 0; i < job.n_part; ++i) {
    LinearJob::Part& part = job.part[i];
    part.weight = static_cast<const std::byte*>(y->src[1 + i]->data);
    part.bias = node.has_bias[i] ? values(y->src[i_bias++]) : nullptr;
    part.y = out;
    if (!job.gated) out += part.d_out * job.n_row * number_size(job.y_type);
  }
  if (node.has_residual) job.part[job.n_part - 1].residual = values(y->src[i_bias++]);
  if (job.norm.run != nullptr) job.norm.weight = values(y->src[i_bias++]);
  if (node.has_norm_bias) job.norm.bias = values(y->src[i_bias]);
  node.kernel->run(job, ith, nth, node.scratch->of(ith));
}

/// Operands are read once and results written once; what x and W take in between stays in caches.
Work work_of_job(const LinearJob& job, ggml_tensor* y) {
  Work work = work_of(y);  // of a custom node: the bytes
  for (int i = 0; i < job.n_part; ++i) work.flop += 2.0 * static_cast<double>(job.n_row * job.d_in * job.part[i].d_out);
  return work;
}

/// The kernel that all terms share, or null.
const LinearKernel* kernel_of(Graph& g, std::span<const LinearTerm> terms) {
  const MatrixFormat* format = g.format(terms[0].weight);
  for (const LinearTerm& term : terms)
    if (g.format(term.weight) != format) return nullptr;
  return static_cast<const LinearKernel*>(format);
}

Tensor emit(Graph& g, const LinearKernel& kernel, std::span<const LinearTerm> terms, Tensor x, Activation activation,
            bool gated, Tensor residual, Readers readers) {
  LinearNode node = {&kernel, &g.scratch(), {}, {}, {}, static_cast<bool>(residual), false};
  const ggml_tensor* normed = nullptr;  // whose norm is computed here
  if (const NormParams* norm = norm_of(g, x);
      norm != nullptr && x.dim(0) <= kernel.max_norm && ggml_is_contiguous(x.node()->src[0])) {
    normed = x.node(), x = normed->src[0];
    node.job.norm = {norm->norm, nullptr, nullptr, norm->eps};
  }
  x = contiguous(g, x);
  std::vector<ggml_tensor*> sources = {x.node()};
  std::int64_t d_out = 0;
  for (const LinearTerm& term : terms) {
    sources.push_back(g.weight(term.weight).node());
    node.job.part[node.job.n_part] = {term.weight->source->type, nullptr, nullptr, nullptr, nullptr,
                                      term.weight->shape[1]};
    node.has_bias[node.job.n_part++] = term.bias != nullptr;
    d_out = (gated ? 0 : d_out) + term.weight->shape[1];
  }
  for (const LinearTerm& term : terms)
    if (term.bias != nullptr) sources.push_back(g.weight(term.bias).node());
  if (residual) sources.push_back(contiguous(g, residual).node());
  if (normed != nullptr) {
    sources.push_back(normed->src[1]);
    node.has_norm_bias = normed->src[2] != nullptr;
    if (node.has_norm_bias) sources.push_back(normed->src[2]);
  }
  node.job.d_in = x.dim(0), node.job.n_row = ggml_nrows(x.node());
  node.job.activation = activation, node.job.gated = gated;
  const bool rounds = readers == Readers::products && kernel.rounds(node.job.n_row, node.job.d_in);
  node.job.x_type = x.node()->type == GGML_TYPE_BF16 ? DType::bf16 : DType::f32;
  node.job.y_type = rounds ? DType::bf16 : DType::f32;
  g.scratch().reserve(kernel.scratch_size);
  const ggml_type type = rounds ? GGML_TYPE_BF16 : GGML_TYPE_F32;
  ggml_tensor* y = ggml_custom_4d(g.context(), type, d_out, x.dim(1), x.dim(2), x.dim(3), sources.data(),
                                  static_cast<int>(sources.size()), linear_task, GGML_N_TASKS_MAX, keep(g, node));
  g.note_work(y, work_of_job(node.job, y));
  return y;
}

/// The reference row: ggml's operations, one after the other, on widened weights.
Tensor ggml_linear(Graph& g, const LinearTerm& term, Tensor x) {
  ggml_tensor* y = ggml_mul_mat(g.context(), g.weight(term.weight).node(), x.node());
  return term.bias != nullptr ? ggml_add(g.context(), y, g.weight(term.bias).node()) : y;
}

}  // namespace

Tensor activate(Graph& g, Activation activation, Tensor x) {
  switch (activation) {
    case Activation::gelu_tanh:
      return gelu_tanh(g, x);
    case Activation::gelu_erf:
      return gelu_erf(g, x);
    case Activation::silu:
      return ggml_silu(g.context(), x.node());
    case Activation::relu:
      return relu(g, x);
    case Activation::none:
      break;
  }
  return x;
}

Tensor linear(Graph& g, const LinearTerm& term, Tensor x, Activation activation, Tensor residual, Readers readers) {
  if (const LinearKernel* kernel = kernel_of(g, {&term, 1}))
    return emit(g, *kernel, {&term, 1}, x, activation, false, residual, readers);
  const Tensor y = activate(g, activation, ggml_linear(g, term, x));
  return residual ? ggml_add(g.context(), residual.node(), y.node()) : y;
}

Tensor gated_linear(Graph& g, const LinearTerm& gate, const LinearTerm& up, Tensor x, Activation activation,
                    Readers readers) {
  const LinearTerm terms[] = {gate, up};
  if (const LinearKernel* kernel = kernel_of(g, terms))
    return emit(g, *kernel, terms, x, activation, true, {}, readers);
  const Tensor factor = activate(g, activation, linear(g, gate, x));
  return ggml_mul(g.context(), factor.node(), linear(g, up, x).node());
}

std::vector<Tensor> linear_group(Graph& g, std::span<const LinearTerm> terms, Tensor x) {
  std::vector<Tensor> parts;
  const LinearKernel* kernel = kernel_of(g, terms);
  if (kernel == nullptr) {
    for (const LinearTerm& term : terms) parts.push_back(linear(g, term, x));
    return parts;
  }
  ggml_tensor* all = emit(g, *kernel, terms, x, Activation::none, false, {}, Readers::any).node();
  const auto n_row = static_cast<std::size_t>(ggml_nrows(x.node()));
  std::size_t offset = 0;
  for (const LinearTerm& term : terms) {  // the results lie one after the other
    const std::int64_t d_out = term.weight->shape[1];
    const std::size_t row = static_cast<std::size_t>(d_out) * sizeof(float);
    const std::size_t plane = row * static_cast<std::size_t>(x.dim(1)),
                      volume = plane * static_cast<std::size_t>(x.dim(2));
    parts.emplace_back(ggml_view_4d(g.context(), all, d_out, x.dim(1), x.dim(2), x.dim(3), row, plane, volume, offset));
    offset += row * n_row;
  }
  return parts;
}

}  // namespace vla::kernels
