// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <map>

#include "kernels/quantized.h"
#include "lower/cpu/emit.h"
#include "lower/layout.h"

namespace vla::lower {
namespace {

class CpuLayouts final : Layouts<CpuLowering> {
 public:
  explicit CpuLayouts(CpuLowering& lowering) : Layouts(lowering) {}

  void run(std::vector<FusedOp> ops) {
    for (FusedOp& op : ops) {
      std::visit([&](auto& what) { choose(op, what); }, op.op);
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
  template <class Op>
  void choose(Step& step, Op& op) {
    meet(step, op.operands());
  }
  void choose(Step& step, LinearOp& op) {
    if (kernel_of(l, *op.linears[0]).quantize != nullptr) {
      const Shape x = l.value(op.x).shape;
      round(step, op, DType::i8, kernels::quantized_stride(x[0]), "quantize");
      l.value(op.x).size = static_cast<std::size_t>(kernels::quantized_size(rows_of(x), x[0]));
    }
    meet(step, op.operands());
  }
  void choose(Step& step, PackOp& op) {
    meet(step, op.operands());
    l.value(step.writes[0]).size = attention_kernel(l, op.rounds).packed_size(pack_sizes(l, op));
  }

  void round_result(const CpuOp& op, const LinearOp& linear) {
    if (linear.residual != kNone || linear.factor != kNone) return;
    for (const ValueId id : op.writes)
      round_result(id, kernel_of(l, *linear.linears[0]).y_layout(linear.linears[0]->in[0].dim(0)));
  }
  void round_result(const CpuOp& op, const AttentionOp& node) {
    if (l.value(op.writes[0]).shape[0] % kernels::kTileSide == 0)
      round_result(op.writes[0], attention_kernel(l, node.rounds).rounded);
  }

  /// Stores a value rounded if only products and attention read it, which would round it anyway.
  void round_result(ValueId id, kernels::RoundedLayout layout) {
    Value& y = l.value(id);
    if (layout == kernels::RoundedLayout::none || y.placement != Value::Placement::arena) return;
    for (const Value* view : views_[id])
      if (view->node != nullptr && view->node->tapped) return;
    for (const auto& [op, read] : reads_[id])
      if (!takes(*op, read, layout)) return;
    for (Value* view : views_[id]) {
      view->type = DType::bf16, view->layout = static_cast<int>(layout);
      if (layout == kernels::RoundedLayout::tiles) view->form = " tiles ";
    }
    y.size = static_cast<std::size_t>(kernels::rounded_count(layout, rows_of(y.shape), y.shape[0])) * 2;
  }

  /// Whether an operation can read a value, or a view of it, in a rounded layout: a product must read the whole value;
  /// attention must read rows of heads without a norm or rotation.
  bool takes(const CpuOp& op, ValueId id, kernels::RoundedLayout layout) const {
    if (const auto* linear = std::get_if<LinearOp>(&op.op))
      return id == linear->x && id == l.value(id).base && linear->norm == nullptr && linear->unfold == nullptr &&
             id != linear->residual && id != linear->factor && kernel_of(l, *linear->linears[0]).rounded == layout;
    const auto takes_heads = [&](const HeadRows& rows, bool rounds) {
      const bool is_plain = id != rows.x || (rows.norm == nullptr && rows.rope == nullptr);
      return is_plain && id != rows.table && attention_kernel(l, rounds).rounded == layout && lies_in_rows(id);
    };
    if (const auto* pack = std::get_if<PackOp>(&op.op)) return takes_heads(pack->k, pack->rounds);
    if (const auto* node = std::get_if<AttentionOp>(&op.op))
      return id != node->mask && takes_heads(node->q, node->rounds);
    return false;
  }

  /// Each head of a token or batch must be part of one row of the base.
  bool lies_in_rows(ValueId id) const {
    const Value& x = l.value(id);
    const std::int64_t d = l.base(id).shape[0];
    return x.stride[2] % d == 0 && x.stride[3] % d == 0 &&
           x.offset % d + (x.shape[1] - 1) * x.stride[1] + x.shape[0] <= d;
  }

  // For each base: the operations that read it or a view of it, and the value with its views.
  std::map<ValueId, std::vector<std::pair<const CpuOp*, ValueId>>> reads_;
  std::map<ValueId, std::vector<Value*>> views_;
};

}  // namespace

const kernels::LinearKernel& kernel_of(const CpuLowering& l, const Node& linear) {
  return l.weights.kernel(linear.as<op::Linear>()->weight)->for_batch(rows_of(linear.in[0].shape()));
}

void choose_layouts(CpuLowering& l, std::vector<FusedOp> ops) { CpuLayouts(l).run(std::move(ops)); }

}  // namespace vla::lower
