// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/emit.h"

#include <algorithm>
#include <cmath>

#include "kernels/cpu_kernels.h"
#include "kernels/sizes.h"
#include "lower/cpu/tasks.h"

namespace vla::lower {
namespace {

using kernels::KindClock;

/// A product of fewer operations takes about as long as waking a thread.
constexpr double kMinSharedFlop = 2e6;
/// Elements of an item of what is not a product.
constexpr std::int64_t kItemElements = 16384;

std::byte* address(const CpuLowering& l, ValueId id) {
  const Value& value = l.value(id);
  return l.address(value.base) + dtype_size(value.type, value.offset);
}
float* floats(const CpuLowering& l, ValueId id) { return reinterpret_cast<float*>(address(l, id)); }
/// Null for an operand that there is not.
const float* operand(const CpuLowering& l, ValueId id) { return id != kNone ? floats(l, id) : nullptr; }

const kernels::CpuKernels& cpu(const CpuLowering& l) { return *kernels::cpu_kernels(l.use); }
const kernels::AttentionKernel* attention_kernel(const CpuLowering& l, bool rounds) {
  return &kernels::cpu_kernels(l.features(rounds))->attention;
}

/// Cuts rows of d elements into items for the threads, and says how many rows an item has.
std::int64_t item_rows(const CpuLowering& l, std::int64_t n_row, std::int64_t d, std::int64_t& n_item) {
  const std::int64_t wanted = l.n_thread == 1 ? 1 : std::min<std::int64_t>(n_row * d / kItemElements, 8 * l.n_thread);
  const std::int64_t rows = kernels::ceil_div(n_row, std::max<std::int64_t>(1, wanted));
  n_item = kernels::ceil_div(n_row, rows);
  return rows;
}

kernels::RowPrep prep_of(const CpuLowering& l, const Prepared& rows) {
  kernels::RowPrep prep;
  if (rows.norm != nullptr) {
    const auto& norm = *rows.norm->as<op::Norm>();
    prep.norm = norm.kind == op::NormKind::rms ? cpu(l).rms_norm : cpu(l).layer_norm;
    prep.weight = floats(l, rows.weight), prep.eps = norm.eps;
  }
  if (rows.rope != nullptr) prep.rotate = cpu(l).rotate_half, prep.table = floats(l, rows.table);
  return prep;
}

/// x [d_head, n_head, n_token, n_batch].
kernels::HeadRows head_rows(const CpuLowering& l, ValueId id) {
  const Value &x = l.value(id), &base = l.base(id);
  return {l.address(x.base), x.offset, x.stride[1], x.stride[2], x.stride[3], rounded(x), base.shape[0]};
}

double flop_of_op(const CpuOp& op);
struct FlopOf {
  double operator()(const BlockedOp& op) const { return sum(op.products, flop_of_op); }
  double operator()(const LinearOp& op) const {
    return sum(op.linears, [](const Node* node) { return flop_of(*node); });
  }
  double operator()(const AttentionOp& op) const { return flop_of(*op.node); }
  // Counted are products alone.
  double operator()(const QuantizeOp&) const { return 0; }
  double operator()(const PackOp&) const { return 0; }
  double operator()(const RowOp&) const { return 0; }
  double operator()(const CopyOp&) const { return 0; }
  double operator()(const LookupOp&) const { return 0; }
  double operator()(const PatchesOp&) const { return 0; }
  double operator()(const WindowOp&) const { return 0; }
  double operator()(const ChannelOp& op) const { return flop_of(*op.node); }

 private:
  template <class Of, class Flop>
  static double sum(const Of& all, const Flop& flop) {
    double result = 0;
    for (const auto& one : all) result += flop(one);
    return result;
  }
};
double flop_of_op(const CpuOp& op) { return std::visit(FlopOf{}, op.op); }

/// Threads that share an operation.
int threads_for(const CpuLowering& l, const CpuOp& op) { return flop_of_op(op) < kMinSharedFlop ? 1 : l.n_thread; }

/// The norm that LinearOp and QuantizeOp apply to the rows that they read.
template <class Reader>
kernels::LinearJob::Norm norm_of(const CpuLowering& l, const Reader& op) {
  if (op.norm == nullptr) return {};
  const auto& norm = *op.norm->template as<op::Norm>();
  return {norm.kind == op::NormKind::rms ? cpu(l).rms_norm : cpu(l).layer_norm, operand(l, op.norm_weight),
          operand(l, op.norm_bias), norm.eps};
}

kernels::Window window_of(const Shape& x, const op::Window& w, const Shape& y) {
  return {x[0], x[1], x[2], w.size, w.stride, w.padding, y[1], y[2]};
}

/// All but the addresses of matrices.
kernels::LinearJob job_of(const CpuLowering& l, const CpuOp& op) {
  const auto& linear = std::get<LinearOp>(op.op);
  kernels::LinearJob job = {};
  const Value& x = l.value(linear.x);
  job.x = address(l, linear.x), job.x_type = x.type, job.x_stride = row_stride(x);
  const Shape& rows = linear.unfold != nullptr ? linear.unfold->shape : x.shape;
  job.d_in = rows[0], job.n_row = count(rows) / rows[0];
  if (linear.unfold != nullptr) job.window = window_of(x.shape, linear.unfold->as<op::Unfold>()->window, rows);
  job.activation = linear.activation, job.gated = linear.gated, job.ends_in_relu = linear.ends_in_relu;
  job.norm = norm_of(l, linear);
  for (const Node* node : linear.linears) {
    const auto& product = *node->as<op::Linear>();
    kernels::LinearJob::Part& part = job.part[job.n_part++];
    part.type = l.weights.encoding(product.weight).type;
    part.bias = product.bias != nullptr ? l.weights.floats(product.bias) : nullptr;
    part.d_out = product.weight->shape[1];
    // Of gate and up the one result is up's.
    const std::size_t i = linear.gated ? 0 : static_cast<std::size_t>(job.n_part - 1);
    part.y = address(l, op.writes[i]), part.y_type = l.value(op.writes[i]).type;
  }
  kernels::LinearJob::Part& last = job.part[job.n_part - 1];
  last.factor = operand(l, linear.factor), last.residual = operand(l, linear.residual);
  return job;
}

void note_uses(const LinearOp& linear, kernels::LinearJob& job, MatrixUses& uses) {
  for (std::size_t i = 0; i < linear.linears.size(); ++i)
    uses.push_back({&job.part[i], linear.linears[i]->as<op::Linear>()->weight});
}

std::unique_ptr<Task> make(const CpuLowering& l, const CpuOp& op, const LinearOp& linear, MatrixUses& uses) {
  auto task = std::make_unique<LinearTask>();
  task->kernel = &kernel_of(l, linear), task->job = job_of(l, op);
  task->n_item = task->kernel->cut(task->job, threads_for(l, op));
  note_uses(linear, task->job, uses);
  return task;
}

/// Scratch memory of a thread: the kernels', and behind it the elements between the products of a block.
struct BlockedScratch {
  std::size_t kernels, inner;
};
BlockedScratch scratch_sizes(const CpuLowering& l, const BlockedOp& blocked) {
  const Value& inner = l.value(blocked.products[0].writes[0]);
  const std::int64_t d = inner.shape[0], n_square = kernels::ceil_div(count(inner.shape) / d, kernels::kTileSide);
  const std::int64_t n_row = kernels::ceil_div(n_square, blocked.n_block) * kernels::kTileSide;
  return {aligned(std::max(scratch_of(l, blocked.products[0]), scratch_of(l, blocked.products[1]))),
          2 * static_cast<std::size_t>(kernels::rounded_count(rounded(inner), n_row, d))};
}

std::unique_ptr<Task> make(const CpuLowering& l, const CpuOp&, const BlockedOp& blocked, MatrixUses& uses) {
  auto task = std::make_unique<BlockedTask>();
  for (std::size_t i = 0; i < 2; ++i) {
    const auto& linear = std::get<LinearOp>(blocked.products[i].op);
    task->kernel[i] = &kernel_of(l, linear), task->job[i] = job_of(l, blocked.products[i]);
    note_uses(linear, task->job[i], uses);
  }
  task->inner = scratch_sizes(l, blocked).kernels, task->n_item = blocked.n_block;
  return task;
}

std::unique_ptr<Task> make(const CpuLowering& l, const CpuOp& op, const QuantizeOp& quantize, MatrixUses&) {
  auto task = std::make_unique<QuantizeTask>();
  const Value &x = l.value(quantize.x), &codes = l.value(op.writes[0]);
  task->norm = norm_of(l, quantize), task->quantize = quantize.kernel->quantize;
  task->x = floats(l, quantize.x), task->x_stride = row_stride(x);
  task->codes = address(l, op.writes[0]), task->codes_stride = row_stride(codes);
  task->d = x.shape[0], task->n_row = count(x.shape) / x.shape[0];
  task->item_rows = item_rows(l, task->n_row, task->d, task->n_item);
  return task;
}

std::unique_ptr<Task> make(const CpuLowering& l, const CpuOp& op, const PackOp& pack, MatrixUses&) {
  auto task = std::make_unique<PackTask>();
  task->kernel = attention_kernel(l, pack.rounds);
  task->job = pack_sizes(l, pack);
  task->job.k = head_rows(l, pack.k.x), task->job.v = head_rows(l, pack.v), task->job.prep = prep_of(l, pack.k);
  task->job.packed = address(l, op.writes[0]);
  task->n_item = task->kernel->n_pack(task->job);
  return task;
}

std::unique_ptr<Task> make(const CpuLowering& l, const CpuOp& op, const AttentionOp& attention, MatrixUses&) {
  auto task = std::make_unique<AttentionTask>();
  kernels::AttentionJob& job = task->job;
  const Value& q = l.value(attention.q.x);
  task->kernel = attention_kernel(l, attention.rounds);
  job.d_head = q.shape[0], job.n_head = q.shape[1], job.n_query = q.shape[2], job.n_batch = q.shape[3];
  job.n_head_kv = attention.node->in.back().dim(1);
  job.scale = 1.0f / std::sqrt(static_cast<float>(job.d_head));
  job.q = head_rows(l, attention.q.x), job.prep = prep_of(l, attention.q);
  job.mask = operand(l, attention.mask);
  for (std::size_t i = 0; i < attention.packed.size(); ++i) {
    job.segment[job.n_segment++] = {address(l, attention.packed[i]), attention.n_key[i], job.n_key};
    job.n_key += attention.n_key[i];
  }
  job.out = address(l, op.writes[0]), job.out_layout = rounded(l.value(op.writes[0]));
  task->n_item = task->kernel->cut(job, threads_for(l, op));
  return task;
}

/// The kernel of a row operation, and how it takes its second operand.
struct SetRowKernel {
  const CpuLowering& l;
  const RowOp& row;
  RowTask& task;

  void operator()(const op::Norm& norm) const {
    task.kernel = norm.kind == op::NormKind::rms ? cpu(l).rms_norm : cpu(l).layer_norm, task.s = norm.eps;
  }
  void operator()(const op::Rope&) const { task.kernel = cpu(l).rotate_half, task.w_stride = {1, 0, task.shape[0], 0}; }
  void operator()(const op::Activate& op) const { task.kernel = cpu(l).activation(op.activation); }
  void operator()(const op::Scale& op) const { task.kernel = cpu(l).scale, task.s = op.factor; }
  void operator()(const op::Add&) const {
    broadcast();
    task.kernel = cpu(l).add;
  }
  void operator()(const op::Multiply&) const {
    broadcast();
    task.kernel = task.w_is_scalar ? cpu(l).scale : cpu(l).multiply;
  }

 private:
  void broadcast() const {
    const Value& w = l.value(row.w);
    for (std::size_t i = 1; i < 4; ++i) task.w_stride[i] = w.shape[i] == 1 ? 0 : w.stride[i];
    task.w_is_scalar = w.shape[0] == 1 && task.shape[0] != 1;
  }
};

std::unique_ptr<Task> make(const CpuLowering& l, const CpuOp& op, const RowOp& row, MatrixUses&) {
  auto task = std::make_unique<RowTask>();
  const Node& node = *row.node;
  task->x = floats(l, row.x), task->x_stride = l.value(row.x).stride;
  task->w = operand(l, row.w), task->b = operand(l, row.b);
  task->y = floats(l, op.writes[0]), task->shape = node.shape;
  std::visit(SetRowKernel{l, row, *task}, row.what);
  task->item_rows = item_rows(l, count(node.shape) / node.shape[0], node.shape[0], task->n_item);
  return task;
}

std::unique_ptr<Task> make(const CpuLowering& l, const CpuOp& op, const CopyOp& copy, MatrixUses&) {
  auto task = std::make_unique<CopyTask>();
  task->n_item = 0;
  for (const CopyOp::Part& part : copy.parts) {
    std::int64_t n_item = 0;
    const std::int64_t rows = item_rows(l, count(part.shape) / part.shape[0], part.shape[0], n_item);
    task->parts.push_back({reinterpret_cast<const std::uint32_t*>(address(l, part.from)) + part.from_offset,
                           reinterpret_cast<std::uint32_t*>(address(l, op.writes[0])) + part.to_offset, part.shape,
                           part.from_stride, part.to_stride, rows, task->n_item});
    task->n_item += n_item;
  }
  return task;
}

std::unique_ptr<Task> make(const CpuLowering& l, const CpuOp& op, const LookupOp& lookup, MatrixUses&) {
  const Node& node = *lookup.node;
  const auto* ids = reinterpret_cast<const std::int32_t*>(address(l, lookup.ids));
  float* const y = floats(l, op.writes[0]);
  if (const auto* embedding = node.as<op::Embedding>()) {
    auto task = std::make_unique<EmbeddingTask>();
    task->table = l.weights.rows(embedding->table), task->type = embedding->table->encoding.type;
    task->ids = ids, task->y = y, task->d = node.shape[0], task->n = node.shape[1], task->n_item = 1;
    return task;
  }
  auto task = std::make_unique<GatherTask>();
  task->rows = floats(l, lookup.table), task->row_stride = l.value(lookup.table).stride[1];
  task->ids = ids, task->y = y, task->d = node.shape[0], task->n = node.shape[1];
  task->item_rows = item_rows(l, task->n, task->d, task->n_item);
  return task;
}

std::unique_ptr<Task> make(const CpuLowering& l, const CpuOp& op, const PatchesOp& patches, MatrixUses&) {
  auto task = std::make_unique<PatchesTask>();
  const Node& node = *patches.node;
  task->images = floats(l, patches.images), task->y = floats(l, op.writes[0]);
  task->width = node.in[0].dim(0), task->height = node.in[0].dim(1), task->size = node.as<op::Patches>()->size;
  task->n_item = task->height / task->size * node.in[0].dim(3);
  return task;
}

std::unique_ptr<Task> make(const CpuLowering& l, const CpuOp& op, const WindowOp& at, MatrixUses&) {
  auto task = std::make_unique<WindowTask>();
  const Node& node = *at.node;
  task->window = window_of(node.in[0].shape(), at.window, node.shape);
  task->largest = at.takes_largest ? cpu(l).largest : nullptr;
  task->multiply_add = at.weight != kNone ? cpu(l).multiply_add : nullptr;
  task->x = floats(l, at.x), task->weight = operand(l, at.weight), task->bias = operand(l, at.bias);
  task->y = floats(l, op.writes[0]);
  task->n_item = node.shape[2] * node.shape[3];
  return task;
}

std::unique_ptr<Task> make(const CpuLowering& l, const CpuOp& op, const ChannelOp& at, MatrixUses&) {
  static_assert(op::ChannelAttention::kMaxGroup <= kernels::kMaxChannels);
  auto task = std::make_unique<ChannelTask>();
  const Shape& shape = at.node->shape;
  task->kernel = cpu(l).channel_attention;
  task->job = {floats(l, at.q),
               floats(l, at.k),
               floats(l, at.v),
               floats(l, op.writes[0]),
               row_stride(l.value(at.q)),
               row_stride(l.value(at.k)),
               row_stride(l.value(at.v)),
               shape[0],
               shape[1],
               shape[2],
               at.node->as<op::ChannelAttention>()->n_group};
  task->n_item = task->job.n_unit();
  return task;
}

std::size_t bytes_of(const Value& value) { return dtype_size(value.type, count(value.shape)); }

}  // namespace

kernels::PackJob pack_sizes(const CpuLowering& l, const PackOp& op) {
  const Value& k = l.value(op.k.x);
  return {k.shape[0], k.shape[1], k.shape[2], k.shape[3], {}, {}, {}, nullptr};
}

std::unique_ptr<Task> emit(const CpuLowering& l, const CpuOp& op, MatrixUses& uses) {
  return std::visit([&](const auto& what) { return make(l, op, what, uses); }, op.op);
}

namespace {

struct ScratchOf {
  const CpuLowering& l;

  std::size_t operator()(const LinearOp& op) const { return kernel_of(l, op).scratch_size; }
  std::size_t operator()(const BlockedOp& op) const {
    const BlockedScratch size = scratch_sizes(l, op);
    return size.kernels + size.inner;
  }
  std::size_t operator()(const QuantizeOp& op) const {
    return op.norm != nullptr ? static_cast<std::size_t>(l.value(op.x).shape[0]) * sizeof(float) : 0;
  }
  std::size_t operator()(const PackOp&) const { return 0; }
  std::size_t operator()(const AttentionOp&) const { return 0; }
  std::size_t operator()(const RowOp&) const { return 0; }
  std::size_t operator()(const CopyOp&) const { return 0; }
  std::size_t operator()(const LookupOp&) const { return 0; }
  std::size_t operator()(const PatchesOp&) const { return 0; }
  std::size_t operator()(const WindowOp&) const { return 0; }
  std::size_t operator()(const ChannelOp&) const { return 0; }
};

struct KindOf {
  using Kind = KindClock::Kind;

  Kind operator()(const LinearOp&) const { return KindClock::products; }
  Kind operator()(const BlockedOp&) const { return KindClock::products; }
  Kind operator()(const PackOp&) const { return KindClock::attention; }
  Kind operator()(const AttentionOp&) const { return KindClock::attention; }
  Kind operator()(const QuantizeOp&) const { return KindClock::norms; }
  Kind operator()(const RowOp& op) const {
    return std::holds_alternative<op::Norm>(op.what) ? KindClock::norms : KindClock::others;
  }
  Kind operator()(const CopyOp&) const { return KindClock::others; }
  Kind operator()(const LookupOp&) const { return KindClock::others; }
  Kind operator()(const PatchesOp&) const { return KindClock::others; }
  Kind operator()(const WindowOp&) const { return KindClock::others; }
  Kind operator()(const ChannelOp&) const { return KindClock::attention; }
};

}  // namespace

std::size_t scratch_of(const CpuLowering& l, const CpuOp& op) { return std::visit(ScratchOf{l}, op.op); }

KindClock::Kind kind_of(const CpuOp& op) { return std::visit(KindOf{}, op.op); }

Work work_of(const CpuLowering& l, const CpuOp& op) {
  Work work;
  if (const auto* blocked = std::get_if<BlockedOp>(&op.op)) {
    for (const CpuOp& product : blocked->products) work += work_of(l, product);
    return work;
  }
  work.flop = flop_of_op(op);
  const auto* lookup = std::get_if<LookupOp>(&op.op);
  for (const ValueId id : op.reads) {
    // Of a table only the rows that are looked up are read.
    const Value& value = lookup != nullptr && id == lookup->table ? l.value(op.writes[0]) : l.value(id);
    work.bytes += static_cast<double>(value.node != nullptr ? bytes_of(value) : value.size);
  }
  for (const ValueId id : op.writes) {
    const Value& value = l.value(id);
    work.bytes += static_cast<double>(value.node != nullptr ? bytes_of(value) : value.size);
  }
  if (const auto* linear = std::get_if<LinearOp>(&op.op)) {
    for (const Node* node : linear->linears) {
      const auto& product = *node->as<op::Linear>();
      work.weights += static_cast<double>(l.weights.encoding(product.weight).size(product.weight->count()));
      if (product.bias != nullptr) work.weights += 4.0 * static_cast<double>(product.bias->shape[0]);
    }
    work.bytes += work.weights;
    if (kernel_of(l, *linear).quantize != nullptr) work.int8 = work.flop;
  }
  return work;
}

}  // namespace vla::lower
