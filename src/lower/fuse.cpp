// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <iterator>
#include <map>
#include <tuple>

#include "lower/lowering.h"

namespace vla::lower {
namespace {

std::size_t at(const Node* node) { return static_cast<std::size_t>(node->id); }

class Fuser {
 public:
  explicit Fuser(Lowering& lowering) : l(lowering) {}

  std::vector<FusedOp> run() {
    for (const Node& node : l.graph.nodes())
      if (l.needed[at(&node)] && !l.fused[at(&node)]) visit(node);
    join_products();
    fuse_norms();
    fuse_windows();
    // A norm or a window that its readers compute is no operation.
    std::erase_if(ops_, [&](const FusedOp& op) {
      const auto* row = std::get_if<RowOp>(&op.op);
      const auto* window = std::get_if<WindowOp>(&op.op);
      return (row != nullptr && l.fused[at(row->node)]) || (window != nullptr && l.fused[at(window->node)]);
    });
    for (FusedOp& op : ops_) note_operands(op);
    std::stable_sort(ops_.begin(), ops_.end(), [](const FusedOp& a, const FusedOp& b) { return a.order < b.order; });
    return std::move(ops_);
  }

 private:
  void add(decltype(FusedOp::op) op, const Node& result) {
    FusedOp& added = ops_.emplace_back();
    added.op = std::move(op), added.writes = {result.id}, added.order = result.id;
  }

  void visit(const Node& node) {
    std::visit([&](const auto& op) { visit(node, op); }, node.op);
  }

  // Leaves are values; what a slot gets is the result of another operation (store.cpp).
  void visit(const Node&, const op::Input&) {}
  void visit(const Node&, const op::Constant&) {}
  void visit(const Node&, const op::Parameter&) {}
  void visit(const Node&, const op::Write&) {}

  void visit(const Node& node, const op::Linear&) { visit_linear(node); }
  void visit(const Node& node, const op::Attention&) { visit_attention(node); }
  void visit(const Node& node, const op::Concat& op) { add(concat(node, op), node); }
  void visit(const Node& node, const op::PixelShuffle& op) { add(pixel_shuffle(node, op), node); }
  void visit(const Node& node, const op::Embedding&) { add(LookupOp{&node, operand(node, 0)}, node); }
  void visit(const Node& node, const op::Gather&) { add(LookupOp{&node, operand(node, 1), operand(node, 0)}, node); }
  void visit(const Node& node, const op::Patches&) { add(PatchesOp{&node, operand(node, 0)}, node); }
  void visit(const Node& node, const op::Unfold& op) { add(WindowOp{&node, op.window, false, operand(node, 0)}, node); }
  void visit(const Node& node, const op::MaxPool& op) { add(WindowOp{&node, op.window, true, operand(node, 0)}, node); }

  void visit(const Node& node, const op::Depthwise& op) {
    add(WindowOp{&node, op.window, false, operand(node, 0), operand(node, 1), operand(node, 2)}, node);
  }
  void visit(const Node& node, const op::ChannelAttention&) {
    add(ChannelOp{&node, operand(node, 0), operand(node, 1), operand(node, 2)}, node);
  }

  void visit(const Node& node, const op::Norm& op) { add_rows(node, op); }
  void visit(const Node& node, const op::Rope& op) { add_rows(node, op); }
  void visit(const Node& node, const op::Activate& op) { add_rows(node, op); }
  void visit(const Node& node, const op::Add& op) { add_rows(node, op); }
  void visit(const Node& node, const op::Multiply& op) { add_rows(node, op); }
  void visit(const Node& node, const op::Scale& op) { add_rows(node, op); }
  void add_rows(const Node& node, decltype(RowOp::what) what) {
    add(RowOp{&node, what, operand(node, 0), operand(node, 1), operand(node, 2)}, node);
  }

  // Copies where a view would do but must not be one.
  void visit(const Node& node, const op::Slice& op) {
    const ValueId x = operand(node, 0);
    copy(node, [&](CopyOp::Part& part) {
      part.from_offset = op.first * l.value(x).stride[static_cast<std::size_t>(op.dim)];
    });
  }
  void visit(const Node& node, const op::Repeat&) {
    const Shape& from = node.in[0].shape();
    copy(node, [&](CopyOp::Part& part) {
      for (std::size_t i = 0; i < 4; ++i)
        if (from[i] == 1) part.from_stride[i] = 0;
    });
  }
  void visit(const Node& node, const op::Reshape&) {
    const Shape& from = node.in[0].shape();
    copy(node, [&](CopyOp::Part& part) { part.shape = from, part.to_stride = contiguous_strides(from); });
  }
  template <class Change>
  void copy(const Node& node, const Change& change) {
    if (l.value(node.id).base != node.id) return;  // a view
    const ValueId x = operand(node, 0);
    CopyOp::Part part = {x, node.shape, l.value(x).stride, contiguous_strides(node.shape), 0};
    change(part);
    add(CopyOp{{part}}, node);
  }

  static ValueId operand(const Node& node, std::size_t i) { return i < node.in.size() ? node.in[i].node()->id : kNone; }

  CopyOp concat(const Node& node, const op::Concat& concat) const {
    CopyOp op;
    const auto dim = static_cast<std::size_t>(concat.dim);
    const Shape to = contiguous_strides(node.shape);
    std::int64_t offset = 0;
    for (Tensor part : node.in) {
      const Value& from = l.value(part.node()->id);
      op.parts.push_back({part.node()->id, from.shape, from.stride, to, offset});
      offset += from.shape[dim] * to[dim];
    }
    return op;
  }

  /// Patch (factor R + r, factor C + c) becomes part (r, c) of token (R, C): one copy for each
  /// part.
  CopyOp pixel_shuffle(const Node& node, const op::PixelShuffle& shuffle) const {
    const auto [n_column, factor] = shuffle;
    const Value& x = l.value(node.in[0].node()->id);
    const std::int64_t d = x.shape[0], row = x.stride[1], n_row = x.shape[1] / n_column;
    CopyOp op;
    for (int r = 0; r < factor; ++r)
      for (int c = 0; c < factor; ++c) {
        CopyOp::Part part;
        part.from = node.in[0].node()->id;
        part.shape = {d, n_column / factor, n_row / factor, x.shape[2]};
        part.from_stride = {x.stride[0], factor * row, factor * n_column * row, x.stride[2]};
        part.to_stride = {1, node.shape[0], node.shape[0] * (n_column / factor), node.shape[0] * node.shape[1]};
        part.to_offset = (r * factor + c) * d;
        // The part begins at patch (r, c).
        part.from_offset = (r * n_column + c) * row;
        op.parts.push_back(part);
      }
    return op;
  }

  /// The only node that reads this one, if there is exactly one and no tap, unless it is part of something already.
  const Node* only_reader(const Node& node) const {
    if (node.tapped || l.readers[at(&node)].size() != 1) return nullptr;
    const Node* reader = l.readers[at(&node)][0];
    return l.fused[at(reader)] ? nullptr : reader;
  }

  static const Param& weight(const Node& linear) { return *linear.as<op::Linear>()->weight; }
  const void* multiplier(const Node& linear) const { return l.target.multiplier(weight(linear)); }

  void visit_linear(const Node& linear) {
    LinearOp op;
    op.linears = {&linear}, op.x = linear.in[0].node()->id;
    const Node* result = &linear;
    if (const Node* gated = fuse_gate(linear, op)) {
      result = gated;
    } else {
      if (const Node* next = only_reader(*result); next != nullptr && next->as<op::Activate>() != nullptr)
        op.activation = next->as<op::Activate>()->activation, result = take(next);
      if (const Node* next = only_reader(*result); next != nullptr && next->as<op::Multiply>() != nullptr &&
                                                   next->in[0].node() == result && is_vector(next->in[1], *result))
        op.factor = next->in[1].node()->id, result = take(next);
      if (const Node* next = only_reader(*result); next != nullptr && next->as<op::Add>() != nullptr) {
        const Tensor other = next->in[next->in[0].node() == result ? 1 : 0];
        if (other.shape() == result->shape) op.residual = other.node()->id, result = take(next);
      }
      if (op.residual != kNone && l.target.takes_relu(weight(linear)))
        if (const Node* next = only_reader(*result); next != nullptr && is_relu(*next))
          op.ends_in_relu = true, result = take(next);
    }
    add(std::move(op), *result);
  }

  static bool is_relu(const Node& node) {
    const auto* activate = node.as<op::Activate>();
    return activate != nullptr && activate->activation == Activation::relu;
  }

  const Node* take(const Node* node) {
    l.fused[at(node)] = true;
    return node;
  }

  /// [d] of elements that follow each other, for every row of a result.
  bool is_vector(Tensor factor, const Node& result) const {
    return factor.dim(0) == result.shape[0] && count(factor.shape()) == factor.dim(0) &&
           l.value(factor.node()->id).stride[0] == 1;
  }

  /// activation(gate) * up, where `linear` is one of the two and the other has the same x.
  const Node* fuse_gate(const Node& linear, LinearOp& op) {
    const Node* next = only_reader(linear);
    const Node* activate = next != nullptr && next->as<op::Activate>() != nullptr ? next : nullptr;
    const Node* product = activate != nullptr ? only_reader(*activate) : next;
    if (product == nullptr || product->as<op::Multiply>() == nullptr) return nullptr;
    const Node* self = activate != nullptr ? activate : &linear;
    const Node* other = product->in[product->in[0].node() == self ? 1 : 0].node();
    const Node *gate = &linear, *up = other;
    if (activate == nullptr) {  // then the other side must be the activated one
      if (other->as<op::Activate>() == nullptr || only_reader(*other) != product) return nullptr;
      activate = other, gate = other->in[0].node(), up = &linear;
      if (gate->as<op::Linear>() == nullptr || only_reader(*gate) != activate) return nullptr;
    }
    if (up->as<op::Linear>() == nullptr || only_reader(*up) != product || up->in[0] != gate->in[0] ||
        multiplier(*up) != multiplier(*gate) || up->shape != gate->shape)
      return nullptr;
    op.linears = {gate, up}, op.gated = true, op.activation = activate->as<op::Activate>()->activation;
    take(gate), take(up), take(activate);
    return take(product);
  }

  /// A norm or a rotation of heads that only this attention reads is done while it copies the rows.
  Prepared prepared(Tensor x) {
    Prepared result = {x.node()->id};
    const auto is_only = [&](const Node* node) { return !node->tapped && l.readers[at(node)].size() == 1; };
    const Node* node = x.node();
    if (node->as<op::Rope>() != nullptr && is_only(node)) {
      result.rope = node, result.table = operand(*node, 1);
      node = node->in[0].node();
      result.x = node->id;
    }
    const auto* norm = node->as<op::Norm>();
    if (norm != nullptr && node->in.size() == 2 && is_only(node)) {
      result.norm = node, result.weight = operand(*node, 1);
      result.x = operand(*node, 0);
    }
    return result;
  }

  /// Rows of norms and rotations were visited before the attention that takes them.
  void drop(const Prepared& rows) {
    for (const Node* node : {rows.norm, rows.rope})
      if (node != nullptr) l.fused[at(node)] = true;
  }

  ValueId pack(Tensor k, Tensor v, const Node& attention, bool rounds) {
    const auto [known, is_new] = packs_.try_emplace({k.node()->id, v.node()->id, rounds}, kNone);
    if (!is_new) return known->second;
    const ValueId id = static_cast<ValueId>(l.values.size());
    Value& value = l.values.emplace_back();
    value.base = id, value.shape = k.shape();
    PackOp op = {prepared(k), v.node()->id, rounds};
    drop(op.k);
    add(std::move(op), attention);
    ops_.back().writes = {id};
    return known->second = id;
  }

  /// Whether a matrix made it that is float32 or float16 in memory.
  bool comes_from_floats(Tensor x) const {
    const Node* node = x.node();
    while (node->as<op::Linear>() == nullptr && !node->in.empty()) node = node->in[0].node();
    if (node->as<op::Linear>() == nullptr) return false;
    const DType type = l.target.encoding(weight(*node)).type;
    return type == DType::f32 || type == DType::f16;
  }

  void visit_attention(const Node& node) {
    const bool has_mask = node.as<op::Attention>()->has_mask;
    const std::size_t first = has_mask ? 2 : 1;
    std::int64_t n_key = 0;
    for (std::size_t i = first; i < node.in.size(); i += 2) n_key += node.in[i].dim(2);
    const bool rounds = n_key >= l.target.min_rounded_keys() && !comes_from_floats(node.in[0]);
    AttentionOp op = {&node, prepared(node.in[0]), rounds};
    drop(op.q);
    if (has_mask) op.mask = node.in[1].node()->id;
    for (std::size_t i = first; i < node.in.size(); i += 2) {
      op.packed.push_back(pack(node.in[i], node.in[i + 1], node, rounds));
      op.n_key.push_back(node.in[i].dim(2));
    }
    add(std::move(op), node);
  }

  /// Products of one x that nothing follows share the reading of it.
  void join_products() {
    std::map<std::pair<ValueId, const void*>, FusedOp*> open;
    for (FusedOp& op : ops_) {
      auto* linear = std::get_if<LinearOp>(&op.op);
      if (linear == nullptr || linear->gated || linear->activation != Activation::none || linear->factor != kNone ||
          linear->residual != kNone)
        continue;
      FusedOp*& first = open[{linear->x, multiplier(*linear->linears[0])}];
      if (first == nullptr || first->writes.size() == l.target.max_products()) {
        first = &op;
        continue;
      }
      std::get<LinearOp>(first->op).linears.push_back(linear->linears[0]);
      first->writes.push_back(op.writes[0]);
      op.writes.clear();
    }
    std::erase_if(ops_, [](const FusedOp& op) { return op.writes.empty(); });
  }

  /// A norm that products alone read is computed by them, row by row as they copy x.
  void fuse_norms() {
    for (FusedOp& op : ops_) {
      auto* linear = std::get_if<LinearOp>(&op.op);
      if (linear == nullptr) continue;
      const Node* norm = l.node(linear->x);
      if (norm == nullptr || norm->as<op::Norm>() == nullptr || norm->tapped) continue;
      const bool takes = std::all_of(l.readers[at(norm)].begin(), l.readers[at(norm)].end(), [&](const Node* reader) {
        return reader->as<op::Linear>() != nullptr && norm->shape[0] <= l.target.max_norm(weight(*reader));
      });
      const Value& x = l.value(norm->in[0].node()->id);
      if (!takes || row_stride(x) < 0) continue;
      linear->norm = norm, linear->x = operand(*norm, 0);
      linear->norm_weight = operand(*norm, 1), linear->norm_bias = operand(*norm, 2);
      l.fused[at(norm)] = true;
    }
  }

  /// Fuses Unfold into the products that read it: they take what a window covers place by place as they copy x.
  void fuse_windows() {
    for (FusedOp& op : ops_) {
      auto* linear = std::get_if<LinearOp>(&op.op);
      if (linear == nullptr || linear->norm != nullptr) continue;
      const Node* unfold = l.node(linear->x);
      if (unfold == nullptr || unfold->as<op::Unfold>() == nullptr || unfold->tapped) continue;
      const bool takes =
          std::all_of(l.readers[at(unfold)].begin(), l.readers[at(unfold)].end(), [&](const Node* reader) {
            return reader->as<op::Linear>() != nullptr && l.target.takes_windows(weight(*reader));
          });
      if (!takes) continue;
      linear->unfold = unfold, linear->x = operand(*unfold, 0);
      l.fused[at(unfold)] = true;
    }
  }

  static void note_operands(FusedOp& op) {
    const std::vector<ValueId> all = std::visit([](const auto& what) { return operands(what); }, op.op);
    std::copy_if(all.begin(), all.end(), std::back_inserter(op.reads), [](ValueId id) { return id != kNone; });
  }
  static std::vector<ValueId> operands(const LinearOp& op) {
    return {op.x, op.factor, op.residual, op.norm_weight, op.norm_bias};
  }
  static std::vector<ValueId> operands(const PackOp& op) { return {op.k.x, op.k.weight, op.k.table, op.v}; }
  static std::vector<ValueId> operands(const AttentionOp& op) {
    std::vector<ValueId> all = op.packed;
    all.insert(all.end(), {op.q.x, op.q.weight, op.q.table, op.mask});
    return all;
  }
  static std::vector<ValueId> operands(const CopyOp& op) {
    std::vector<ValueId> all;
    for (const CopyOp::Part& part : op.parts) all.push_back(part.from);
    return all;
  }
  static std::vector<ValueId> operands(const RowOp& op) { return {op.x, op.w, op.b}; }
  static std::vector<ValueId> operands(const LookupOp& op) { return {op.table, op.ids}; }
  static std::vector<ValueId> operands(const PatchesOp& op) { return {op.images}; }
  static std::vector<ValueId> operands(const WindowOp& op) { return {op.x, op.weight, op.bias}; }
  static std::vector<ValueId> operands(const ChannelOp& op) { return {op.q, op.k, op.v}; }

  Lowering& l;
  std::vector<FusedOp> ops_;
  std::map<std::tuple<ValueId, ValueId, bool>, ValueId> packs_;
};

}  // namespace

std::vector<FusedOp> fuse(Lowering& l) { return Fuser(l).run(); }

}  // namespace vla::lower
