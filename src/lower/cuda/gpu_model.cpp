// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/gpu_model.h"

#include <algorithm>
#include <cmath>
#include <string>

namespace vla::lower {
namespace {

constexpr double kTera = 1e12, kGiga = 1e9, kMicro = 1e-6;

// Sources: NVIDIA's data sheets and white papers of AGX Orin, GA102, GB202, H100 and H200. Two figures are recalled
// from published reports and unchecked: mma.sync reaches 0.62 of the peak of the H100's tensor units; and the time of a
// launch in a graph on GPUs other than Hopper. Hopper's launch time is that of small kernels of acts on an H200, each
// begun before the previous kernel ends.

/// H100 and H200 differ only in their memory.
constexpr GpuModel hopper(const char* name, const char* description, double bandwidth) {
  return {.name = name,
          .description = description,
          .n_sm = 132,
          .is_hopper = true,
          .clock = 1.83 * kGiga,
          .bf16 = 0.62 * 989 * kTera,
          .int8 = 0.62 * 1979 * kTera,
          .f32 = 66.9 * kTera,
          .dot4 = 133.8 * kTera,
          .bandwidth = bandwidth,
          .shared = 228 << 10,
          .launch = 2.5 * kMicro};
}
constexpr GpuModel kModels[] = {
    {.name = "orin-agx",
     .description = "Jetson AGX Orin 64 GB, 16 SMs at 1.3 GHz",
     .n_sm = 16,
     .clock = 1.3 * kGiga,
     .bf16 = 42.6 * kTera,
     .int8 = 85 * kTera,
     .f32 = 5.3 * kTera,
     .dot4 = 10.6 * kTera,
     .bandwidth = 204.8 * kGiga,
     .shared = 164 << 10,
     .launch = 2.5 * kMicro},
    {.name = "rtx-3060",
     .description = "GeForce RTX 3060 12 GB, 28 SMs at 1.78 GHz",
     .n_sm = 28,
     .clock = 1.78 * kGiga,
     .bf16 = 25.5 * kTera,
     .int8 = 102 * kTera,
     .f32 = 12.7 * kTera,
     .dot4 = 25.5 * kTera,
     .bandwidth = 360 * kGiga,
     .shared = 100 << 10,
     .launch = 1.3 * kMicro},
    {.name = "rtx-5090",
     .description = "GeForce RTX 5090 32 GB, 170 SMs at 2.41 GHz",
     .n_sm = 170,
     .clock = 2.41 * kGiga,
     .bf16 = 209.5 * kTera,
     .int8 = 838 * kTera,
     .f32 = 104.8 * kTera,
     .dot4 = 209.6 * kTera,
     .bandwidth = 1792 * kGiga,
     .shared = 100 << 10,
     .launch = 1.0 * kMicro},
    hopper("h100", "H100 SXM 80 GB, 132 SMs at 1.83 GHz", 3350 * kGiga),
    hopper("h200", "H200 SXM 141 GB, 132 SMs at 1.83 GHz", 4800 * kGiga),
};

// Assumptions for other GPUs, never measured. kSmBytes: bytes that an SM reads from the L2 cache per cycle. kIssue: the
// fraction of issue slots that a quarter of an SM fills when nothing else stalls it. kKernelCycles: cycles of the
// smallest kernel. kMemoryLatency: seconds.
constexpr double kSmBytes = 22;
constexpr double kIssue = 0.75, kKernelCycles = 4000, kMemoryLatency = 0.8 * kMicro;

/// The main loop of a tensor-core kernel, whose blocks have one or two warps per quarter of an SM. Instructions are
/// counted in the machine code for sm_90 (scripts/cuda_kernels.py cubins; tests/cuda/ptx_test.py compares them); those
/// of attention include the mask's branch.
struct Loop {
  const char* kernel;
  int instructions, tensor;  // instructions of a warp per step: all, and on tensor cores
  int registers;             // registers per thread
  int step;                  // elements of the depth, or keys, per step
  int stage, n_stage;        // bytes read per step, and steps that fit in shared memory
  int n_warp = 4;            // warps per block
};
constexpr Loop kLoops[] = {
    {"linear_bf16_64", 163, 16, 94, 32, 2 * 64 * 64, 4},
    {"linear_bf16_128", 333, 64, 227, 32, 2 * 128 * 64, 4},
    {"linear_ternary_64", 122, 16, 90, 64, 64 * (64 + 16), 4},
    {"linear_ternary_128", 228, 64, 206, 64, 128 * (64 + 16), 4},
    {"linear_int4_64", 188, 16, 100, 64, 64 * (64 + 33), 4},
    {"linear_int4_128", 366, 64, 224, 64, 128 * (64 + 33), 4},
    {"linear_int8_64", 98, 16, 96, 64, 2 * 64 * 64, 3},
    {"linear_int8_128", 200, 64, 238, 64, 2 * 128 * 64, 3},
    {"attention_bf16_64", 762, 64, 163, 64, 2 * 64 * (2 * 64 + 16), 2},
    {"attention_bf16_64_32", 879, 64, 126, 256, 256 * (2 * 64 + 16), 2, 8},
    {"attention_bf16_64_16", 687, 32, 108, 256, 256 * (2 * 64 + 16), 2, 8},
    {"attention_bf16_80", 834, 80, 187, 64, 2 * 64 * (2 * 80 + 16), 2},
    {"attention_bf16_128", 944, 128, 224, 64, 2 * 64 * (2 * 128 + 16), 2},
    {"attention_bf16_128_32", 713, 64, 127, 128, 128 * (2 * 128 + 16), 2, 8},
    {"attention_bf16_128_16", 592, 32, 116, 128, 128 * (2 * 128 + 16), 2, 8},
    {"attention_bf16_256", 619, 64, 163, 32, 32 * (2 * 256 + 16), 2, 8},
    {"attention_bf16_256_32", 661, 64, 125, 64, 64 * (2 * 256 + 16), 2, 8},
};

const Loop& loop_of(const std::string& kernel) { return *std::ranges::find(kLoops, kernel, &Loop::kernel); }

/// The cost of an operation on a GPU.
struct Cost {
  double products = 0;  // seconds with all SMs busy
  double alone = 0;     // seconds on an otherwise idle GPU, in whole waves of blocks
  double bytes = 0;
  // seconds to read memory on an otherwise idle GPU, limited by the bytes that its blocks have in flight
  double fetch = 0;
  int n_launch = 0;  // launches whose time is not in `alone`
};

class Costs {
 public:
  Costs(const CudaLowering& lowering, const GpuModel& model) : l(lowering), gpu(model) {}

  /// `n_launch`: the number of kernels of the operation.
  Cost of(const CudaOp& op, int n_launch) const {
    Cost cost;
    cost.n_launch = n_launch;
    cost.bytes = work_of(l, op).bytes;
    cost.fetch = cost.bytes / gpu.bandwidth;
    if (const auto* linear = std::get_if<LinearOp>(&op.op)) add_products(cost, op, *linear);
    if (const auto* attention = std::get_if<AttentionOp>(&op.op)) add_attention(cost, op, *attention);
    return cost;
  }

 private:
  /// Adds a time fitted to measurements on Hopper, from launch to end.
  static void add_measured(Cost& cost, double us) {
    cost.products += us * kMicro, cost.alone += us * kMicro;
    cost.n_launch = 0;
  }
  /// Adds the time of equal blocks; each SM runs its blocks one after the other.
  void add_blocks(Cost& cost, double n_block, double of_block) const {
    cost.products += n_block * of_block / gpu.n_sm;
    cost.alone += std::ceil(n_block / gpu.n_sm) * of_block;
  }
  /// Adds the time of tensor-core blocks: each quarter of an SM issues its warps' instructions while its tensor unit
  /// multiplies.
  void add_loops(Cost& cost, double n_block, double n_step, const Loop& loop, double rate,
                 double of_instruction) const {
    const double tensor_cycles = of_instruction * 4 * gpu.n_sm * gpu.clock / rate;
    const double cycles = loop.n_warp / 4 * std::max(loop.tensor * tensor_cycles, loop.instructions / kIssue);
    add_blocks(cost, n_block, n_step * cycles / gpu.clock);
    const int registers = (loop.registers + 7) / 8 * 8 * 32 * loop.n_warp;
    const double most = std::min((64 << 10) / registers, gpu.shared / (loop.n_stage * loop.stage));
    const double at_work = std::min(n_block, gpu.n_sm * most);
    const double asked = at_work * (loop.n_stage - 1) * loop.stage;  // bytes in flight
    cost.fetch = std::max(cost.fetch, cost.bytes / (asked / kMemoryLatency));
  }
  void add_products(Cost& cost, const CudaOp& op, const LinearOp& linear) const {
    for (const Node* node : linear.linears) {
      const Param& weight = *node->as<op::Linear>()->weight;
      const MatrixKind kind = l.matrix(*node).kind;
      const std::int64_t columns = weight.shape[1], rows = count(node->shape) / columns;
      const auto [shape, n_split, tile, in_cluster, us, by_tma] = op.cut;
      const std::int64_t size = shape == cuda::Bf16Shape::rows128 && kind != MatrixKind::f32 ? 128 : 64;
      const double tiles = static_cast<double>(ceil_div(columns, size) * ceil_div(rows, size));
      if (kind == MatrixKind::f32) {  // padded rows and columns are multiplied, too
        const double padded = tiles * static_cast<double>(size * size) * 2 * static_cast<double>(weight.shape[0]);
        add_blocks(cost, tiles, padded / tiles / (gpu.f32 / gpu.n_sm));
      } else if (gpu.is_hopper && us > 0) {
        const bool is_one = linear.gated && op.gate == kNone;  // `us` is the time of gate and up together
        add_measured(cost, us / (is_one ? 2 : 1));
      } else if (const std::int64_t width = strip_width(shape); width > 0) {
        const std::int64_t n_block = ceil_div(columns, width) * ceil_div(rows, 64) * n_split;
        const std::int64_t bytes = (std::min<std::int64_t>(rows, 64) + width) * weight.shape[0] * 2 / n_split;
        add_blocks(cost, static_cast<double>(n_block), static_cast<double>(bytes) / (kSmBytes * gpu.clock));
      } else if (shape == cuda::Bf16Shape::few) {
        add_blocks(cost, gpu.n_sm, flop_of(*node) / (is_of_codes(kind) ? gpu.dot4 : gpu.f32));
      } else {
        const Loop& loop = loop_of(kernel_name(kind) + (size == 128 ? "_128" : "_64"));
        const double n_step = std::ceil(static_cast<double>(weight.shape[0]) / loop.step / n_split);
        add_loops(cost, tiles * n_split, n_step, loop, is_of_codes(kind) ? gpu.int8 : gpu.bf16,
                  2 * 16 * 8 * (is_of_codes(kind) ? 32 : 16));
      }
    }
  }
  void add_attention(Cost& cost, const CudaOp& op, const AttentionOp& attention) const {
    const Shape& q = l.value(attention.q.x).shape;
    const AttentionPlan& plan = op.plan;
    if (!attention.rounds) {
      const double n_block = static_cast<double>(ceil_div(q[2], 8) * q[1] * q[3]) * plan.n_split;
      return add_blocks(cost, n_block, flop_of(*attention.node) / n_block / (gpu.f32 / gpu.n_sm));
    }
    if (gpu.is_hopper) return add_measured(cost, plan.us);
    const Loop& loop = loop_of(plan.shape->kernel);
    // Two multiply-adds per query, key and element of a head: scores and weighted values.
    const double n_key = flop_of(*attention.node) / (4.0 * static_cast<double>(count(q)));
    const std::int64_t n_head_kv = l.value(attention.packed[0]).shape[1], n_row = q[1] / n_head_kv * q[2];
    const std::int64_t n_block = ceil_div(n_row, plan.shape->rows) * n_head_kv * q[3] * plan.n_split;
    add_loops(cost, static_cast<double>(n_block), std::ceil(n_key / loop.step / plan.n_split), loop, gpu.bf16,
              2 * 16 * 8 * 16);
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
  std::vector<Program::Prediction> all(n_stage + 1);  // the last entry is `prepare`
  // Operations of a phase run concurrently and share units and memory.
  for (std::size_t first = 0, end = 0; first < l.ops.size(); first = end) {
    Cost together;
    double alone = 0, fetch = 0;
    int longest = 0, n_kernel = 0;
    for (; end < l.ops.size() && l.ops[end].phase == l.ops[first].phase; ++end) {
      const Cost cost = costs.of(l.ops[end], n_launch[end]);
      together.products += cost.products, together.bytes += cost.bytes;
      alone = std::max(alone, cost.alone), fetch = std::max(fetch, cost.fetch);
      longest = std::max(longest, cost.n_launch), n_kernel += n_launch[end];
    }
    const bool is_prepared = l.ops[first].phase < l.n_prepare;
    Program::Prediction prediction;
    prediction.products = std::max(together.products, alone);
    prediction.bytes = std::max(together.bytes / gpu.bandwidth, fetch);
    prediction.launches = longest * (gpu.launch + (gpu.is_hopper ? 0 : kKernelCycles / gpu.clock));
    prediction.n_launch = n_kernel;
    prediction.seconds = std::max(prediction.products, prediction.bytes) + prediction.launches;
    all[is_prepared ? n_stage : stage_of(l, l.ops[first])] += prediction;
  }
  return all;
}

}  // namespace vla::lower
