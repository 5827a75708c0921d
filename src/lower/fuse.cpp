// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <map>
#include <tuple>

#include "lower/ops.h"

namespace vla::lower {
namespace {

std::size_t at(const Node* node) { return static_cast<std::size_t>(node->id); }

class Fuser {
 public:
  explicit Fuser(Lowering& lowering) : l(lowering), readers_(needed_.size()), fused_(needed_.size(), false) {
    for (const Node& node : l.graph.nodes())
      if (needed_[at(&node)])
        for (Tensor in : node.in) readers_[at(in.node())].push_back(&node);
  }

  std::vector<FusedOp> run() {
    for (const Node& node : l.graph.nodes())
      if (needed_[at(&node)] && !fused_[at(&node)]) std::visit([&](const auto& op) { visit(node, op); }, node.op);
    join_products();
    fuse_readings();
    // A norm or a window that its readers compute needs no operation of its own.
    std::erase_if(ops_, [&](const FusedOp& op) {
      const auto* row = std::get_if<RowOp>(&op.op);
      const auto* window = std::get_if<WindowOp>(&op.op);
      return (row != nullptr && fused_[at(row->node)]) || (window != nullptr && fused_[at(window->node)]);
    });
    for (FusedOp& op : ops_) {
      for (const Operand& read : std::visit([](auto& what) { return what.operands(); }, op.op))
        if (read.id != kNone) op.reads.push_back(read.id);
      if (const auto* linear = std::get_if<LinearOp>(&op.op)) op.matrices = matrices_of(linear->linears);
    }
    std::ranges::stable_sort(ops_, {}, &FusedOp::order);
    return std::move(ops_);
  }

 private:
  void add(decltype(FusedOp::op) op, const Node& result) {
    ops_.push_back({{.writes = {result.id}, .order = result.id}, std::move(op)});
  }

  // Leaves are values, not operations; writes to slots are handled in store.cpp.
  void visit(const Node&, const op::Input&) {}
  void visit(const Node&, const op::Constant&) {}
  void visit(const Node&, const op::Parameter&) {}
  void visit(const Node&, const op::Write&) {}

  template <class Op>
  void visit(const Node& node, const Op& op) {
    if (l.value(node.id).base == node.id) add(lowered(l, node, op), node);  // else it is a view
  }

  /// Returns the only reader of a node, or null if it has several, is tapped, or the reader was fused already.
  const Node* only_reader(const Node& node) const {
    if (node.tapped || readers_[at(&node)].size() != 1) return nullptr;
    const Node* reader = readers_[at(&node)][0];
    return fused_[at(reader)] ? nullptr : reader;
  }
  /// The same for a reader of one kind.
  template <class Op>
  const Node* only_reader(const Node& node) const {
    const Node* reader = only_reader(node);
    return reader != nullptr && reader->as<Op>() != nullptr ? reader : nullptr;
  }
  /// The other operand of a sum or product of two.
  static Tensor other_operand(const Node& of, const Node* than) { return of.in[of.in[0].node() == than ? 1 : 0]; }

  Multiplier multiplier(const Node& linear) const { return l.target.multiplier(*linear.as<op::Linear>()->weight); }
  static std::vector<const Param*> matrices_of(const std::vector<const Node*>& linears) {
    std::vector<const Param*> matrices;
    for (const Node* linear : linears) matrices.push_back(linear->as<op::Linear>()->weight);
    return matrices;
  }
  /// Whether one operation may read the matrices of these products and of one more.
  bool may_join(std::vector<const Node*> linears, const Node* other) const {
    const bool has_kernel = multiplier(*other).kernel == multiplier(*linears[0]).kernel;
    linears.push_back(other);
    return has_kernel && share_group(l, matrices_of(linears));
  }

  void visit(const Node& linear, const op::Linear&) {
    LinearOp op;
    op.linears = {&linear}, op.x = linear.in[0].node()->id;
    if (const Node* gated = fuse_gate(linear, op)) return add(std::move(op), *gated);
    const Node* result = &linear;
    if (const Node* next = only_reader<op::Activate>(*result))
      op.activation = next->as<op::Activate>()->activation, result = take(next);
    if (const Node* next = only_reader<op::Multiply>(*result);
        next != nullptr && next->in[0].node() == result && is_vector(next->in[1], *result))
      op.factor = next->in[1].node()->id, result = take(next);
    if (const Node* next = only_reader<op::Add>(*result)) {
      const Tensor other = other_operand(*next, result);
      if (other.shape() == result->shape) op.residual = other.node()->id, result = take(next);
    }
    if (op.residual != kNone && multiplier(linear).takes_relu)
      if (const Node* next = only_reader<op::Activate>(*result);
          next != nullptr && next->as<op::Activate>()->activation == Activation::relu)
        op.ends_in_relu = true, result = take(next);
    add(std::move(op), *result);
  }

  const Node* take(const Node* node) {
    fused_[at(node)] = true;
    return node;
  }

  /// Whether a tensor is [d], contiguous, and applies to every row of a result.
  bool is_vector(Tensor factor, const Node& result) const {
    return factor.dim(0) == result.shape[0] && count(factor.shape()) == factor.dim(0) &&
           l.value(factor.node()->id).stride[0] == 1;
  }

  /// Matches activation(gate) * up, where `linear` is one of the two products and both read the same x.
  const Node* fuse_gate(const Node& linear, LinearOp& op) {
    const Node* activate = only_reader<op::Activate>(linear);
    const Node* self = activate != nullptr ? activate : &linear;
    const Node* product = only_reader<op::Multiply>(*self);
    if (product == nullptr) return nullptr;
    const Node* other = other_operand(*product, self).node();
    const Node *gate = &linear, *up = other;
    if (activate == nullptr) {  // the other factor must be the activated one
      if (other->as<op::Activate>() == nullptr || only_reader(*other) != product) return nullptr;
      activate = other, gate = other->in[0].node(), up = &linear;
      if (gate->as<op::Linear>() == nullptr || only_reader(*gate) != activate) return nullptr;
    }
    if (up->as<op::Linear>() == nullptr || only_reader(*up) != product || up->in[0] != gate->in[0] ||
        !may_join({gate}, up) || up->shape != gate->shape)
      return nullptr;
    op.linears = {gate, up}, op.gated = true, op.activation = activate->as<op::Activate>()->activation;
    take(gate), take(up), take(activate);
    return take(product);
  }

  /// Matches a norm or rotation of heads that only this attention reads; attention applies it as it copies the rows.
  /// Operations of their own exist already and are removed at the end.
  HeadRows prepared(Tensor x) {
    HeadRows result = {x.node()->id};
    const auto is_only = [&](const Node* node) { return !node->tapped && readers_[at(node)].size() == 1; };
    const Node* node = x.node();
    if (node->as<op::Rope>() != nullptr && is_only(node)) {
      result.rope = take(node), result.table = operand(*node, 1);
      node = node->in[0].node();
      result.x = node->id;
    }
    const auto* norm = node->as<op::Norm>();
    if (norm != nullptr && node->in.size() == 2 && is_only(node)) {
      result.norm = take(node), result.weight = operand(*node, 1);
      result.x = operand(*node, 0);
    }
    return result;
  }

  ValueId pack(Tensor k, Tensor v, const Node& attention, bool rounds) {
    const auto [known, is_new] = packs_.try_emplace({k.node()->id, v.node()->id, rounds}, kNone);
    if (!is_new) return known->second;
    const ValueId id = static_cast<ValueId>(l.values.size());
    Value& value = l.values.emplace_back();
    value.base = id, value.shape = k.shape();
    add(PackOp{prepared(k), v.node()->id, rounds}, attention);
    ops_.back().writes = {id};
    return known->second = id;
  }

  /// Whether x comes from a product with a matrix that is float32 or float16 in memory.
  bool comes_from_floats(Tensor x) const {
    const Node* node = x.node();
    while (node->as<op::Linear>() == nullptr && !node->in.empty()) node = node->in[0].node();
    if (node->as<op::Linear>() == nullptr) return false;
    const DType type = multiplier(*node).encoding->type;
    return type == DType::f32 || type == DType::f16;
  }

  void visit(const Node& node, const op::Attention& attention) {
    const std::size_t first = attention.has_mask ? 2 : 1;
    std::int64_t n_key = 0;
    for (std::size_t i = first; i < node.in.size(); i += 2) n_key += node.in[i].dim(2);
    const bool rounds = n_key >= l.target.min_rounded_keys && !comes_from_floats(node.in[0]);
    AttentionOp op = {.node = &node, .q = prepared(node.in[0]), .rounds = rounds};
    if (attention.has_mask) op.mask = node.in[1].node()->id;
    for (std::size_t i = first; i < node.in.size(); i += 2) {
      op.packed.push_back(pack(node.in[i], node.in[i + 1], node, rounds));
      op.n_key.push_back(node.in[i].dim(2));
    }
    add(std::move(op), node);
  }

  /// Joins products of one x into one operation, which reads x once, if nothing is fused after them.
  void join_products() {
    std::map<std::pair<ValueId, const void*>, FusedOp*> open;
    for (FusedOp& op : ops_) {
      auto* linear = std::get_if<LinearOp>(&op.op);
      if (linear == nullptr || linear->gated || linear->activation != Activation::none || linear->factor != kNone ||
          linear->residual != kNone)
        continue;
      FusedOp*& first = open[{linear->x, multiplier(*linear->linears[0]).kernel}];
      if (first == nullptr || first->writes.size() == l.target.max_products ||
          !may_join(std::get<LinearOp>(first->op).linears, linear->linears[0])) {
        first = &op;
        continue;
      }
      std::get<LinearOp>(first->op).linears.push_back(linear->linears[0]);
      first->writes.push_back(op.writes[0]);
      op.writes.clear();
    }
    std::erase_if(ops_, [](const FusedOp& op) { return op.writes.empty(); });
  }

  /// Fuses a norm or a window into the products that read it, if nothing else reads it. The products compute it as they
  /// copy x, row by row or place by place.
  void fuse_readings() {
    for (FusedOp& op : ops_) {
      auto* linear = std::get_if<LinearOp>(&op.op);
      const Node* read = linear != nullptr ? l.value(linear->x).node : nullptr;
      if (read == nullptr || read->tapped) continue;
      const bool is_norm = read->as<op::Norm>() != nullptr && row_stride(l.value(operand(*read, 0))) >= 0;
      const bool is_window = read->as<op::Unfold>() != nullptr;
      const auto takes = [&](const Node* reader) {
        if (reader->as<op::Linear>() == nullptr) return false;
        const Multiplier by = multiplier(*reader);
        return is_norm ? read->shape[0] <= by.max_norm : by.takes_windows;
      };
      if ((!is_norm && !is_window) || !std::ranges::all_of(readers_[at(read)], takes)) continue;
      (is_norm ? linear->norm : linear->unfold) = take(read), linear->x = operand(*read, 0);
      if (is_norm) linear->norm_weight = operand(*read, 1), linear->norm_bias = operand(*read, 2);
    }
  }

  Lowering& l;
  const std::vector<bool> needed_ = l.graph.needed();
  std::vector<std::vector<const Node*>> readers_;  // needed readers of each node
  std::vector<bool> fused_;                        // nodes that another node's operation computes
  std::vector<FusedOp> ops_;
  std::map<std::tuple<ValueId, ValueId, bool>, ValueId> packs_;
};

}  // namespace

std::vector<FusedOp> fuse(Lowering& l) { return Fuser(l).run(); }

}  // namespace vla::lower
