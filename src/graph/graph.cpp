// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "graph/graph.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <atomic>

#include "graph/shapes.h"

namespace vla {

std::vector<std::int64_t> dims(const Shape& shape) {
  std::size_t n = shape.size();
  while (n > 1 && shape[n - 1] == 1) --n;
  return {shape.begin(), shape.begin() + static_cast<std::ptrdiff_t>(n)};
}

std::string shape_text(const Shape& shape) { return fmt::format("[{}]", fmt::join(dims(shape), ", ")); }

Graph::Graph(Slots& slots, TapFilter filter, Injector injector)
    : slots_(slots), filter_(std::move(filter)), injector_(std::move(injector)) {
  static std::atomic<std::uint64_t> n_graph = 0;
  serial_ = ++n_graph;
}

Tensor Graph::add(Op op, std::vector<Tensor> in, const Shape& shape) {
  const ShapeCheck check = check_shapes(op, in, shape);
  if (!check.fits && problem_.empty()) {
    std::vector<std::string> operands;
    for (Tensor tensor : in) operands.push_back(tensor ? shape_text(tensor.shape()) : "none");
    problem_ = fmt::format("{} {} of {}: operands do not fit", op_name(op), nodes_.size(), fmt::join(operands, ", "));
  }
  return Tensor(&nodes_.emplace_back(Node{.id = static_cast<int>(nodes_.size()),
                                          .op = std::move(op),
                                          .in = std::move(in),
                                          .type = check.type,
                                          .shape = check.shape}));
}

Tensor Graph::input(const Slot* slot) {
  Tensor& leaf = leaves_[slot];
  return leaf ? leaf : leaf = add(op::Input{slot}, {}, slot->shape);
}

Tensor Graph::parameter(const Param* param) {
  Tensor& leaf = leaves_[param];
  return leaf ? leaf : leaf = add(op::Parameter{param}, {}, {param->shape[0], 1, 1, 1});
}

Tensor Graph::constant(const std::string& key, const Shape& shape, const std::function<std::vector<float>()>& make) {
  Tensor& leaf = constants_[key];
  return leaf ? leaf : leaf = constant(make(), shape);
}

Tensor Graph::constant_ids(const std::string& key, const std::function<std::vector<std::int32_t>()>& make) {
  Tensor& leaf = constants_["ids/" + key];
  if (leaf) return leaf;
  std::vector<std::int32_t> ids = make();
  const auto n = static_cast<std::int64_t>(ids.size());
  return leaf = add(op::Constant{std::move(ids)}, {}, {n, 1, 1, 1});
}

Tensor Graph::constant(std::vector<float> values, const Shape& shape) {
  return add(op::Constant{std::move(values)}, {}, shape);
}

namespace {

/// `path`, or `path#2`, `path#3` and so on if a value has it already, because a module runs several times.
std::string unused(const std::deque<Node>& nodes, const std::string& path) {
  std::string numbered = path;
  const auto has_it = [&](const Node& node) { return node.path == numbered; };
  for (int n = 2; std::any_of(nodes.begin(), nodes.end(), has_it); ++n) numbered = fmt::format("{}#{}", path, n);
  return numbered;
}

}  // namespace

Tensor Graph::name(const std::string& of_module, Tensor value) {
  // Only recording and replacing values reads paths, so only then must each be unique.
  const std::string path = filter_ || injector_ ? unused(nodes_, of_module) : of_module;
  if (const Slot* slot = injector_ ? injector_(path, value) : nullptr) value = input(slot);
  Node& node = *value.node();
  if (node.path.empty()) node.path = path;
  if (!filter_ || !filter_(path)) return value;
  // A value has one path. A second path names a copy.
  if (node.path != path || node.tapped || node.as<op::Input>() != nullptr) {
    const Tensor copy = add(op::Reshape{}, {value}, value.shape());
    copy.node()->path = path, copy.node()->tapped = true;
    return value;
  }
  node.tapped = true;
  return value;
}

std::vector<bool> Graph::needed() const {
  std::vector<bool> needed(nodes_.size(), false);
  for (auto node = nodes_.rbegin(); node != nodes_.rend(); ++node) {
    const auto id = static_cast<std::size_t>(node->id);
    needed[id] = needed[id] || node->tapped || node->as<op::Write>() != nullptr;
    if (needed[id])
      for (Tensor in : node->in) needed[static_cast<std::size_t>(in.node()->id)] = true;
  }
  return needed;
}

}  // namespace vla
