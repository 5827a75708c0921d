// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <map>

#include "cuda/kernels/linear_bf16.h"
#include "cuda/kernels/rows.h"
#include "kernels/quantized.h"
#include "lower/cuda/cuda_lowering.h"
#include "lower/layout.h"

namespace vla::lower {
namespace {

class CudaLayouts final : Layouts<CudaLowering> {
 public:
  explicit CudaLayouts(CudaLowering& lowering) : Layouts(lowering) {}

  void run(std::vector<FusedOp> ops) {
    for (FusedOp& op : ops) std::visit([&](auto& what) { choose(op, what); }, op.op);
    for (const CudaOp& op : l.ops)
      for (const ValueId id : op.reads) ++n_reader_[l.value(id).base];
    for (CudaOp& op : l.ops)
      if (auto* round = std::get_if<RoundOp>(&op.op)) round_at_once(op, *round);
    for (CudaOp& op : l.ops)
      if (auto* head = std::get_if<HeadOp>(&op.op)) round_heads_at_once(op, head->rows);
    std::erase_if(l.ops, [](const CudaOp& op) { return op.writes.empty(); });
    for (std::size_t i = 0; i < l.ops.size(); ++i) cut_together(i);
    for (CudaOp& op : l.ops)
      if (auto* head = std::get_if<HeadOp>(&op.op)) rotate_at_once(op, head->rows);
    std::erase_if(l.ops, [](const CudaOp& op) { return op.writes.empty(); });
    if (l.ways.halved_norms) halve_norms(l);
    for (CudaOp& op : l.ops)
      if (const auto* product = std::get_if<LinearOp>(&op.op); product != nullptr && !op.cut.in_cluster)
        split(op, op.cut.n_split, n_sum(op, *product));
    for (CudaOp& op : l.ops)
      if (const auto* round = std::get_if<RoundOp>(&op.op)) finish_in_norm(op, *round);
  }

 private:
  ValueId add_rows(const Shape& shape, DType type = DType::f32) { return add_value(l, shape, type, shape[0]); }

  template <class Op>
  CudaOp& add_op(Step step, Op op) {
    l.ops.push_back({std::move(step), std::move(op)});
    return l.ops.back();
  }
  template <class Op>
  void choose(Step& step, Op& op) {
    meet(step, op.operands());
    add_op(std::move(step), std::move(op));
  }
  /// Makes attention read keys and values in place instead of PackOp's result.
  void choose(Step& step, PackOp& op) {
    const bool rounds = rounds_heads(op.rounds, op.k);
    HeadRows v = {op.v};
    prepare(step, op.k, rounds);
    prepare(step, v, rounds);
    keys_[step.writes[0]] = {op.k.x, v.x};
  }
  /// Makes `rows` read normed, rotated or rounded heads: adds an operation for that before the current one, if needed.
  void prepare(Step& step, HeadRows& rows, bool rounds) {
    meet(step, rows.operands());
    if (rows.norm == nullptr && rows.rope == nullptr && !rounds) return;
    const ValueId to = add_rows(l.value(rows.x).shape, rounds ? DType::bf16 : DType::f32);
    add_op({.reads = step.reads, .writes = {to}, .order = step.order}, HeadOp{rows});
    rows.x = to, rows.norm = rows.rope = nullptr;
  }
  /// bf16 kernels read heads in units of 16 bytes.
  bool rounds_heads(bool rounds, const HeadRows& rows) const { return rounds && l.value(rows.x).shape[0] % 8 == 0; }

  void choose(Step& step, LinearOp& op) {
    const MatrixKind kind = l.matrix(*op.linears[0]).kind;
    const Shape y = op.linears[0]->shape;
    const std::int64_t depth = l.value(op.x).shape[0], n_row = rows_of(y);
    const bool is_one = op.gated && multiplies_both(op, n_row);
    const ProductCut cut = cut_product(l, kind, n_row, is_one ? 2 * y[0] : y[0], depth, is_one);
    if (is_of_codes(kind))
      round(step, op, DType::i8, kernels::quantized_stride(depth), "round");
    else if (kind == MatrixKind::bf16 && cut.shape != cuda::Bf16Shape::few)
      round(step, op, DType::bf16, bf16_stride(depth), "round");
    else if (op.norm != nullptr)
      round(step, op, DType::f32, depth, "round");
    meet(step, op.operands());
    const bool has_gate = op.gated && !is_one;
    CudaOp& made = add_op(std::move(step), std::move(op));
    made.cut = cut;
    if (has_gate) made.writes.push_back(made.gate = add_rows(y));
  }
  /// The number of sums in one share of the depth.
  static std::int64_t n_sum(const CudaOp& op, const LinearOp& product) {
    const Shape& y = product.linears[0]->shape;
    return (count(y) + op.ends.n_more() * y[0]) * (product.gated && op.gate == kNone ? 2 : 1);
  }
  /// Whether an operation is a product of one bf16 matrix that reads nothing but x.
  bool is_plain_product(const CudaOp& op) const {
    const auto* product = std::get_if<LinearOp>(&op.op);
    return product != nullptr && product->linears.size() == 1 && op.reads.size() == 1 &&
           l.matrix(*product->linears[0]).kind == MatrixKind::bf16 && op.cut.shape != cuda::Bf16Shape::few;
  }
  /// Gives the plain products of one x, such as q, k and v, the same cut, so that merge_calls makes one launch of them.
  /// Does nothing if separate launches are faster, or if `first` is not the first product of its x.
  void cut_together(std::size_t first) {
    std::vector<std::size_t> all;
    for (std::size_t i = 0; i < l.ops.size() && all.size() < cuda::kMostJobs; ++i)
      if (is_plain_product(l.ops[i]) && l.ops[i].reads == l.ops[first].reads) all.push_back(i);
    if (all.size() < 2 || all[0] != first) return;
    const auto columns_of = [&](std::size_t i) { return std::get<LinearOp>(l.ops[i].op).linears[0]->shape[0]; };
    std::int64_t n_column = 0;
    double apart = 0;
    for (const std::size_t i : all) n_column += columns_of(i), apart += l.ops[i].cut.us;
    const auto& product = std::get<LinearOp>(l.ops[first].op);
    const Shape& y = product.linears[0]->shape;
    const std::int64_t n_row = rows_of(y), depth = l.value(product.x).shape[0];
    ProductCut cut = cut_product(l, MatrixKind::bf16, n_row, n_column, depth, false);
    if (cut.tile) cut = cut_for_hopper(MatrixKind::bf16, n_row, n_column, depth, HopperCutFor::several, l.n_sm, l.ways);
    const bool is_one_launch = cut.tile || (strip_width(cut.shape) > 0 && cut.n_split == 1);
    if (!is_one_launch || cut.us >= apart) return;
    for (const std::size_t i : all) {
      l.ops[i].cut = cut;
      l.ops[i].cut.us *= static_cast<double>(columns_of(i)) / static_cast<double>(n_column);
    }
  }
  /// Whether one block computes columns of both gate and up.
  bool multiplies_both(const LinearOp& op, std::int64_t n_row) const {
    const bool has_kernel = is_of_strips(n_row, l.value(op.x).shape[0]) || (l.is_hopper && n_row > 64);
    return has_kernel && is_of_bf16(l, op);
  }
  /// Adds the value for partial results if there are several shares. n: floats per share.
  void split(CudaOp& op, int n_split, std::int64_t n) {
    if (n_split > 1) op.writes.push_back(op.partial = add_rows({n, n_split, 1, 1}));
  }
  /// Stores the result of a product, attention or window rounded if `round` is its only reader.
  void round_at_once(CudaOp& round, const RoundOp& what) {
    const Value &x = l.value(what.x), &to = l.value(round.writes[0]);
    const bool is_whole =
        x.base == what.x && x.placement == Value::Placement::arena && x.node != nullptr && !x.node->tapped;
    if (what.norm != nullptr || to.type != DType::bf16 || !is_whole || n_reader_[what.x] != 1) return;
    CudaOp* const maker = maker_of(l, what.x);
    if (maker == nullptr) return;
    const bool is_attention = std::holds_alternative<AttentionOp>(maker->op) && x.shape[0] % 8 == 0;
    const bool is_other = std::holds_alternative<LinearOp>(maker->op) || std::holds_alternative<WindowOp>(maker->op);
    if (!is_attention && !is_other) return;
    maker->writes[0] = round.writes[0];
    round.writes.clear();
  }
  /// The operation that makes heads, if they are all of its result and nothing else reads it; else null.
  CudaOp* maker_of_heads(const HeadRows& rows) {
    const Value &x = l.value(rows.x), &base = l.base(rows.x);
    const bool is_whole = is_contiguous(x) && x.offset == 0 && count(x.shape) == count(base.shape) &&
                          base.placement == Value::Placement::arena && !is_tapped(x.base);
    CudaOp* const maker = is_whole && n_reader_[x.base] == 1 ? maker_of(l, x.base) : nullptr;
    return maker != nullptr && std::holds_alternative<LinearOp>(maker->op) ? maker : nullptr;
  }
  /// Lets a product store the heads that it makes as `head` would, and removes the operation `head`.
  void make_at_once(CudaOp& maker, CudaOp& head) {
    const ValueId to = head.writes[0];
    maker.writes[0] = add_rows(Shape(l.value(maker.writes[0]).shape), l.value(to).type);
    l.value(to).base = maker.writes[0];
    head.writes.clear();
  }
  /// Stores heads rounded by the product that makes them if they are neither normed nor rotated and have no other
  /// reader.
  void round_heads_at_once(CudaOp& head, const HeadRows& rows) {
    if (rows.norm != nullptr || rows.rope != nullptr || l.value(head.writes[0]).type != DType::bf16) return;
    if (CudaOp* const maker = maker_of_heads(rows)) make_at_once(*maker, head);
  }
  /// Rotates heads in the product that makes them, or in the kernel that adds its shares. This shortens a layer's chain
  /// by one kernel.
  void rotate_at_once(CudaOp& head, const HeadRows& rows) {
    const Shape x = l.value(rows.x).shape;
    if (!l.ways.rotations || rows.norm != nullptr || rows.rope == nullptr || x[0] % 8 != 0) return;
    CudaOp* const maker = maker_of_heads(rows);
    if (maker == nullptr || !rotates(*maker)) return;
    const CudaOp* const of_table = maker_of(l, l.value(rows.table).base);
    if (of_table != nullptr && of_table->order >= maker->order) return;
    make_at_once(*maker, head);
    maker->rotation = {rows.table, x[0], x[2]};
    maker->reads.push_back(rows.table);
  }
  /// Whether kernels of a product can rotate its result (cuda::LinearBf16Job::rotation).
  bool rotates(const CudaOp& op) const {
    const auto& product = std::get<LinearOp>(op.op);
    const unsigned width = op.cut.tile ? 0 : strip_width(op.cut.shape);
    const bool has_kernel = op.cut.n_split > 1 ? !op.cut.in_cluster : width > 0 && width <= 64;
    return has_kernel && product.linears.size() == 1 && l.matrix(*product.linears[0]).kind == MatrixKind::bf16 &&
           product.activation == Activation::none && !product.ends_in_relu && product.factor == kNone &&
           product.residual == kNone;
  }
  /// Lets a norm add the depth shares of the product that it reads, if no other operation reads the product's result
  /// before. This shortens a layer's chain by one kernel.
  void finish_in_norm(CudaOp& norm, const RoundOp& what) {
    const Value& x = l.value(what.x);
    const bool is_whole = x.base == what.x && x.placement == Value::Placement::arena && !is_tapped(what.x);
    if (what.norm == nullptr || !is_whole || x.shape[0] > cuda::kMostFinished) return;
    CudaOp* const maker = maker_of(l, what.x);
    if (maker == nullptr || !leaves_plain_shares(*maker)) return;
    const auto reads_first = [&](const CudaOp& op) {
      return std::pair(op.order, &op) < std::pair(norm.order, static_cast<const CudaOp*>(&norm)) &&
             std::ranges::any_of(op.reads, [&](ValueId id) { return l.value(id).base == what.x; });
    };
    if (std::ranges::any_of(l.ops, reads_first)) return;
    norm.finishes = std::make_shared<const CudaOp>(*maker);
    maker->writes = {maker->partial};
    std::ranges::replace(norm.reads, what.x, maker->partial);
    const auto& product = std::get<LinearOp>(maker->op);
    for (const ValueId id : {product.factor, product.residual})
      if (id != kNone) norm.reads.push_back(id);
    norm.writes.push_back(what.x);
  }
  /// Whether an operation is a product of one bf16 matrix with split depth whose shares cuda::FinishNormJob can add: it
  /// supports no activation and no final ReLU.
  bool leaves_plain_shares(const CudaOp& op) const {
    const auto* product = std::get_if<LinearOp>(&op.op);
    return product != nullptr && product->linears.size() == 1 && op.partial != kNone && !leaves_shares(op) &&
           op.cut.n_split <= cuda::kMostSplits && op.ends.squares == kNone &&
           l.matrix(*product->linears[0]).kind == MatrixKind::bf16 && l.value(op.writes[0]).type == DType::f32 &&
           product->activation == Activation::none && !product->ends_in_relu;
  }
  /// Whether a value or a view of it is tapped.
  bool is_tapped(ValueId base) const {
    return std::ranges::any_of(l.values, [&](const Value& value) {
      return value.base == base && value.node != nullptr && value.node->tapped;
    });
  }
  void choose(Step& step, AttentionOp& op) {
    op.rounds = rounds_heads(op.rounds, op.q);
    prepare(step, op.q, op.rounds);
    std::vector<ValueId> keys;
    for (const ValueId packed : op.packed) keys.insert(keys.end(), {keys_.at(packed).first, keys_.at(packed).second});
    op.packed = std::move(keys);
    meet(step, op.operands());
    const Shape q = l.value(op.q.x).shape;
    const AttentionPlan plan = plan_attention(l, op);
    CudaOp& made = add_op(std::move(step), std::move(op));
    made.plan = plan;
    if (!plan.in_cluster) split(made, plan.n_split, (q[0] + 2) * q[1] * q[2] * q[3]);
  }

  std::map<ValueId, std::pair<ValueId, ValueId>> keys_;
  std::map<ValueId, int> n_reader_;  // readers of each base and its views
};

}  // namespace

void choose_layouts(CudaLowering& l, std::vector<FusedOp> ops) { CudaLayouts(l).run(std::move(ops)); }

}  // namespace vla::lower
