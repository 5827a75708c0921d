// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/gpu_model.h"

#include <algorithm>
#include <cmath>

namespace vla::lower {
namespace {

constexpr double kTera = 1e12, kGiga = 1e9, kMicro = 1e-6;

// Sources: NVIDIA's data sheets and white papers of AGX Orin, GA102, GB202 and H100. That mma.sync, which our
// kernels use, reaches 0.62 of the H100's tensor units, and what launches in graphs take, are from memory of what
// others report, and never checked.
constexpr GpuModel kModels[] = {
    {.name = "orin-agx",
     .description = "Jetson AGX Orin 64 GB, 16 SMs at 1.3 GHz",
     .n_sm = 16,
     .bf16 = 42.6 * kTera,
     .int8 = 85 * kTera,
     .f32 = 5.3 * kTera,
     .dot4 = 10.6 * kTera,
     .bandwidth = 204.8 * kGiga,
     .launch = 2.5 * kMicro,
     .attention = 1.35},
    {.name = "rtx-3060",
     .description = "GeForce RTX 3060 12 GB, 28 SMs at 1.78 GHz",
     .n_sm = 28,
     .bf16 = 25.5 * kTera,
     .int8 = 102 * kTera,
     .f32 = 12.7 * kTera,
     .dot4 = 25.5 * kTera,
     .bandwidth = 360 * kGiga,
     .launch = 1.3 * kMicro,
     .attention = 1.0},
    {.name = "rtx-5090",
     .description = "GeForce RTX 5090 32 GB, 170 SMs at 2.41 GHz",
     .n_sm = 170,
     .bf16 = 209.5 * kTera,
     .int8 = 838 * kTera,
     .f32 = 104.8 * kTera,
     .dot4 = 209.6 * kTera,
     .bandwidth = 1792 * kGiga,
     .launch = 1.0 * kMicro,
     .attention = 1.0},
    {.name = "h100",
     .description = "H100 SXM 80 GB, 132 SMs at 1.83 GHz",
     .n_sm = 132,
     .bf16 = 0.62 * 989 * kTera,
     .int8 = 0.62 * 1979 * kTera,
     .f32 = 66.9 * kTera,
     .dot4 = 133.8 * kTera,
     .bandwidth = 3350 * kGiga,
     .launch = 1.0 * kMicro,
     .attention = 1.35},
};

/// An operation's cost on a GPU.
struct Cost {
  double products = 0;  // seconds of all SMs, were they all at work
  double alone = 0;     // seconds where nothing else runs: whole waves of blocks
  double bytes = 0;
  int n_launch = 0;
};

class Costs {
 public:
  Costs(const CudaLowering& lowering, const GpuModel& model) : l(lowering), gpu(model) {}

  /// `n_launch`: of the kernels that the operation is.
  Cost of(const CudaOp& op, int n_launch) const {
    Cost cost;
    cost.n_launch = n_launch;
    cost.bytes = work_of(l, op).bytes;
    if (const auto* linear = std::get_if<LinearOp>(&op.op)) add_products(cost, op, *linear);
    if (const auto* attention = std::get_if<AttentionOp>(&op.op)) add_attention(cost, op, *attention);
    return cost;
  }

 private:
  /// Blocks of equal work, which SMs take one after the other.
  void add_blocks(Cost& cost, double n_block, double flop, double rate) const {
    const double of_block = flop / n_block / (rate / gpu.n_sm), n_sm = gpu.n_sm;
    cost.products += flop / rate;
    cost.alone += std::ceil(n_block / n_sm) * of_block;
  }
  void add_products(Cost& cost, const CudaOp& op, const LinearOp& linear) const {
    for (const Node* node : linear.linears) {
      const Param& weight = *node->as<op::Linear>()->weight;
      const MatrixKind kind = l.matrix(*node).kind;
      const std::int64_t columns = weight.shape[1], rows = count(node->shape) / columns;
      const bool has_codes = kind == MatrixKind::ternary || kind == MatrixKind::int8;
      ProductShape shape = product_shape(kind, rows, columns, l.n_sm);
      if (kind == MatrixKind::f32) shape = ProductShape::rows64;
      const std::int64_t size = shape == ProductShape::rows128 ? 128 : 64;
      const double tiles = static_cast<double>((columns + size - 1) / size * ((rows + size - 1) / size));
      // Rows and columns behind the last are multiplied as well.
      const double padded = tiles * static_cast<double>(size * size) * 2 * static_cast<double>(weight.shape[0]);
      if (shape == ProductShape::few)
        add_blocks(cost, gpu.n_sm, flop_of(*node), has_codes ? gpu.dot4 : gpu.f32);
      else
        add_blocks(cost, tiles * op.n_split, padded,
                   has_codes                  ? gpu.int8
                   : kind == MatrixKind::bf16 ? gpu.bf16
                                              : gpu.f32);
    }
  }
  void add_attention(Cost& cost, const CudaOp& op, const AttentionOp& attention) const {
    const Shape& q = l.value(attention.q.x).shape;
    const std::int64_t size = attention.rounds ? 64 : 8;
    const double blocks = static_cast<double>((q[2] + size - 1) / size * q[1] * q[3]) * op.n_split;
    const double padded = static_cast<double>((q[2] + size - 1) / size * size) / static_cast<double>(q[2]);
    add_blocks(cost, blocks, flop_of(*attention.node) * (attention.rounds ? padded * gpu.attention : 1),
               attention.rounds ? gpu.bf16 : gpu.f32);
  }

  const CudaLowering& l;
  const GpuModel& gpu;
};

}  // namespace

Result<GpuModel> find_gpu_model(const std::string& name) {
  std::string names;
  for (const GpuModel& model : kModels) {
    if (name == model.name) return model;
    names += (names.empty() ? "" : ", ") + std::string(model.name);
  }
  return Error{Code::usage, "model", "one of " + names, name};
}

std::vector<Program::Prediction> predict(const CudaLowering& l, const std::vector<int>& n_launch, const GpuModel& gpu) {
  const Costs costs(l, gpu);
  const std::size_t n_stage = l.graph.stages().size() + 1;
  std::vector<Program::Prediction> all(n_stage + 1);  // the last is that of `prepare`
  // Operations of a phase run side by side, and share units and memory.
  for (std::size_t first = 0, end = 0; first < l.ops.size(); first = end) {
    Cost together;
    double alone = 0;
    int longest = 0, n_kernel = 0;
    for (; end < l.ops.size() && l.ops[end].phase == l.ops[first].phase; ++end) {
      const Cost cost = costs.of(l.ops[end], n_launch[end]);
      together.products += cost.products, together.bytes += cost.bytes;
      alone = std::max(alone, cost.alone), longest = std::max(longest, cost.n_launch), n_kernel += cost.n_launch;
    }
    const bool is_prepared = l.ops[first].phase < l.n_prepare;
    Program::Prediction prediction;
    prediction.products = std::max(together.products, alone), prediction.bytes = together.bytes / gpu.bandwidth;
    prediction.launches = longest * gpu.launch, prediction.n_launch = n_kernel;
    prediction.seconds = std::max(prediction.products, prediction.bytes) + prediction.launches;
    all[is_prepared ? n_stage : stage_of(l, l.ops[first])] += prediction;
  }
  return all;
}

}  // namespace vla::lower
