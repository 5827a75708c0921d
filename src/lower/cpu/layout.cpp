// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <map>

#include "kernels/cpu_kernels.h"
#include "kernels/quantized.h"
#include "lower/copies.h"
#include "lower/cpu/emit.h"

namespace vla::lower {
namespace {

class Layouts : Copies<CpuLowering> {
 public:
  explicit Layouts(CpuLowering& lowering) : Copies(lowering) {}

  void run(std::vector<FusedOp> ops) {
    for (FusedOp& op : ops) {
      step_ = &op;
      std::visit([&](auto& what) { require_layouts(what); }, op.op);
      std::visit([&](auto& what) { l.ops.push_back({static_cast<Step&&>(op), std::move(what)}); }, op.op);
    }
    for (const CpuOp& op : l.ops)
      for (const ValueId id : op.reads) reads_[l.value(id).base].push_back({&op, id});
    for (Value& value : l.values) views_[value.base].push_back(&value);
    for (const CpuOp& op : l.ops) {
      if (const auto* linear = std::get_if<LinearOp>(&op.op)) round_result(op, *linear);
      if (const auto* attention = std::get_if<AttentionOp>(&op.op)) round_result(op, *attention);
    }
  }

 private:
  using Copies::require_rows;
  void require_rows(Prepared& rows) {
    require_rows(rows.x);
    require_rows(rows.weight);
    require_contiguous(rows.table);
  }

  void require_layouts(LinearOp& op) {
    require_contiguous(op.residual);
    const kernels::LinearKernel& kernel = kernel_of(l, op);
    if (kernel.quantize != nullptr) return quantize(op, kernel);
    require(op.x, op.unfold != nullptr ? is_contiguous(l.value(op.x)) : row_stride(l.value(op.x)) >= 0);
    require_rows(op.norm_weight);
    require_rows(op.norm_bias);
  }
  /// The product reads x, or its norm, as codes, which are made once, just before the first operation that reads them.
  void quantize(LinearOp& op, const kernels::LinearKernel& kernel) {
    const auto [known, is_new] = codes_.try_emplace({op.x, op.norm}, static_cast<ValueId>(l.values.size()));
    if (is_new) {
      Value& codes = l.values.emplace_back();
      codes.base = known->second, codes.type = DType::i8, codes.shape = l.value(op.x).shape;
      const std::int64_t stride = kernels::quantized_stride(codes.shape[0]);
      codes.stride = contiguous_strides({stride, codes.shape[1], codes.shape[2], codes.shape[3]});
      codes.size =
          static_cast<std::size_t>(kernels::quantized_size(count(codes.shape) / codes.shape[0], codes.shape[0]));
      QuantizeOp made = {op.x, op.norm, op.norm_weight, op.norm_bias, &kernel};
      require(made.x, row_stride(l.value(made.x)) >= 0);
      require_rows(made.norm_weight);
      require_rows(made.norm_bias);
      CpuOp& quantized = l.ops.emplace_back();
      quantized.reads = {made.x};
      for (const ValueId id : {made.norm_weight, made.norm_bias})
        if (id != kNone) quantized.reads.push_back(id);
      quantized.op = made, quantized.writes = {known->second}, quantized.order = step_->order;
    }
    op.x = known->second;
    op.norm = nullptr, op.norm_weight = op.norm_bias = kNone;
    step_->reads = {op.x};
    for (const ValueId id : {op.factor, op.residual})
      if (id != kNone) step_->reads.push_back(id);
  }
  void require_layouts(PackOp& op) {
    require_rows(op.k);
    require_rows(op.v);
    l.value(step_->writes[0]).size = attention(op.rounds).packed_size(pack_sizes(l, op));
  }
  void require_layouts(AttentionOp& op) {
    require_rows(op.q);
    require_contiguous(op.mask);
  }
  void require_layouts(RowOp& op) {
    require_rows(op.x);
    const std::int64_t d = op.node->shape[0];
    if (std::holds_alternative<op::Add>(op.what) && l.value(op.w).shape[0] != d) op.w = copied(op.w, d);
    if (std::holds_alternative<op::Rope>(op.what)) require_contiguous(op.w);
    require_rows(op.w);
    require_rows(op.b);
  }
  void require_layouts(CopyOp&) {}  // takes anything
  void require_layouts(LookupOp& op) {
    require_rows(op.table);
    require_contiguous(op.ids);
  }
  void require_layouts(PatchesOp& op) { require_contiguous(op.images); }
  void require_layouts(WindowOp& op) {
    require_contiguous(op.x);
    require_contiguous(op.weight);
    require_contiguous(op.bias);
  }
  void require_layouts(ChannelOp& op) {
    for (ValueId* id : {&op.q, &op.k, &op.v}) require(*id, row_stride(l.value(*id)) >= 0);
  }

  void round_result(const CpuOp& op, const LinearOp& linear) {
    if (linear.residual != kNone || linear.factor != kNone) return;
    for (const ValueId id : op.writes) round_result(id, kernel_of(l, linear).y_layout(linear.linears[0]->in[0].dim(0)));
  }
  void round_result(const CpuOp& op, const AttentionOp& node) {
    if (l.value(op.writes[0]).shape[0] % kernels::kTileSide == 0)
      round_result(op.writes[0], attention(node.rounds).rounded);
  }

  const kernels::AttentionKernel& attention(bool rounds) const {
    return kernels::cpu_kernels(l.features(rounds))->attention;
  }

  /// Stores a value that only products and attention read as they would round it.
  void round_result(ValueId id, kernels::RoundedLayout layout) {
    Value& y = l.value(id);
    if (layout == kernels::RoundedLayout::none || y.placement != Value::Placement::arena) return;
    for (const Value* view : views_[id])
      if (view->node != nullptr && view->node->tapped) return;
    for (const auto& [op, read] : reads_[id])
      if (!takes(*op, read, layout)) return;
    for (Value* view : views_[id]) view->type = DType::bf16, view->layout = static_cast<int>(layout);
    y.size = static_cast<std::size_t>(kernels::rounded_count(layout, count(y.shape) / y.shape[0], y.shape[0])) * 2;
  }

  /// Whether an operation may find a value that it reads, or view of one, rounded: as the product of a whole value, or
  /// as rows of heads to which attention does nothing first.
  bool takes(const CpuOp& op, ValueId id, kernels::RoundedLayout layout) const {
    if (const auto* linear = std::get_if<LinearOp>(&op.op))
      return id == linear->x && id == l.value(id).base && linear->norm == nullptr && linear->unfold == nullptr &&
             id != linear->residual && id != linear->factor && kernel_of(l, *linear).rounded == layout;
    const auto takes_heads = [&](const Prepared& rows, bool rounds) {
      const bool is_plain = id != rows.x || (rows.norm == nullptr && rows.rope == nullptr);
      return is_plain && id != rows.table && attention(rounds).rounded == layout && lies_in_rows(id);
    };
    if (const auto* pack = std::get_if<PackOp>(&op.op)) return takes_heads(pack->k, pack->rounds);
    if (const auto* node = std::get_if<AttentionOp>(&op.op))
      return id != node->mask && takes_heads(node->q, node->rounds);
    return false;
  }

  /// Each head of a token or batch is part of one row of the base.
  bool lies_in_rows(ValueId id) const {
    const Value& x = l.value(id);
    const std::int64_t d = l.base(id).shape[0];
    return x.stride[2] % d == 0 && x.stride[3] % d == 0 &&
           x.offset % d + (x.shape[1] - 1) * x.stride[1] + x.shape[0] <= d;
  }

  std::map<std::pair<ValueId, const Node*>, ValueId> codes_;  // of x, or of its norm
  // Of each base: who reads it or a view of it, and itself with its views.
  std::map<ValueId, std::vector<std::pair<const CpuOp*, ValueId>>> reads_;
  std::map<ValueId, std::vector<Value*>> views_;
};

}  // namespace

const kernels::LinearKernel& kernel_of(const CpuLowering& l, const LinearOp& op) {
  const Shape& x = op.linears[0]->in[0].node()->shape;
  return l.weights.kernel(op.linears[0]->as<op::Linear>()->weight)->for_batch(count(x) / x[0]);
}

void choose_layouts(CpuLowering& l, std::vector<FusedOp> ops) { Layouts(l).run(std::move(ops)); }

}  // namespace vla::lower
