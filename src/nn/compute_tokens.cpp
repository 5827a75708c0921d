// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/compute_tokens.h"

#include <map>
#include <optional>

#include "nn/tokens.h"

namespace vla {
namespace {

/// Replaces an operand's token dimension if the whole operand is read.
constexpr int kWhole = -1;

/// The dimension of the old shape that becomes dimension `dim` of the new one, or kWhole if that dimension is merged or
/// split.
int dim_before_reshape(const Shape& from, const Shape& to, int dim) {
  std::int64_t below = 1, inner = 1;
  for (int i = 0; i < dim; ++i) below *= to[static_cast<std::size_t>(i)];
  for (int i = 0; i < 4; inner *= from[static_cast<std::size_t>(i++)])
    if (inner == below && from[static_cast<std::size_t>(i)] == to[static_cast<std::size_t>(dim)]) return i;
  return kWhole;
}

/// For an operation that computes token i of its result (in dimension `dim`) from token i of its operands: the token
/// dimension of each operand, or kWhole for an operand that is read completely. None for operations that mix tokens.
std::optional<std::vector<int>> operands_of_tokens(const Node& node, int dim) {
  std::vector<int> dims(node.in.size(), kWhole);
  const bool is_sum = node.as<op::Add>() != nullptr || node.as<op::Multiply>() != nullptr;
  if (dim == 0) return {};
  if (is_sum || node.as<op::Linear>() != nullptr || node.as<op::Norm>() != nullptr ||
      node.as<op::Activate>() != nullptr || node.as<op::Scale>() != nullptr) {
    dims[0] = dim;
    if (is_sum && node.in[1].dim(dim) != 1) dims[1] = dim;
  } else if (node.as<op::Rope>() != nullptr && dim == 2) {
    dims = {2, 1};
  } else if (const auto* attention = node.as<op::Attention>(); attention != nullptr && dim == 1) {
    dims[0] = 2;
    if (attention->has_mask) dims[1] = 1;
  } else if (node.as<op::Reshape>() != nullptr) {
    dims[0] = dim_before_reshape(node.in[0].shape(), node.shape, dim);
    if (dims[0] == kWhole) return {};
  } else {
    return {};
  }
  return dims;
}

class Narrowing {
 public:
  Narrowing(Graph& g, Tensor y, int first, int count) : g_(g), first_(first), count_(count) {
    find_whole(y);
    result_ = of_tokens(y, 1);
  }
  Tensor result() const { return result_; }

 private:
  /// Visits nodes from last to first, so all readers of a node are known when it is reached.
  void find_whole(Tensor y) {
    const auto& nodes = g_.nodes();
    whole_.assign(nodes.size(), false);
    std::vector<int> dim(nodes.size(), kWhole);  // token dimension, where an operation reads only some tokens
    dim[at(y)] = 1;
    for (auto node = nodes.rbegin(); node != nodes.rend(); ++node) {
      const auto id = static_cast<std::size_t>(node->id);
      std::optional<std::vector<int>> dims;
      if (dim[id] != kWhole && !whole_[id]) dims = operands_of_tokens(*node, dim[id]);
      whole_[id] = whole_[id] || node->tapped || node->as<op::Write>() != nullptr || (dim[id] != kWhole && !dims);
      if (!whole_[id] && !dims) continue;  // no operation needs it
      for (std::size_t i = 0; i < node->in.size(); ++i) {
        const std::size_t in = at(node->in[i]);
        const int wanted = whole_[id] ? kWhole : (*dims)[i];
        if (wanted == kWhole || (dim[in] != kWhole && dim[in] != wanted)) whole_[in] = true;
        dim[in] = wanted == kWhole ? dim[in] : wanted;
      }
    }
  }

  /// Selects the tokens of x in dimension `dim`.
  Tensor of_tokens(Tensor x, int dim) {
    const auto known = made_.find({x.node(), dim});
    if (known != made_.end()) return known->second;
    Tensor made;
    if (whole_[at(x)]) {
      made = slice(g_, x, dim, first_, count_);
    } else {
      const std::vector<int> dims = *operands_of_tokens(*x.node(), dim);
      std::vector<Tensor> in;
      for (std::size_t i = 0; i < dims.size(); ++i)
        in.push_back(dims[i] == kWhole ? x.node()->in[i] : of_tokens(x.node()->in[i], dims[i]));
      Shape shape = x.shape();
      shape[static_cast<std::size_t>(dim)] = count_;
      made = g_.add(x.node()->op, std::move(in), shape);
      made.node()->path = x.node()->path;
    }
    return made_[{x.node(), dim}] = made;
  }

  static std::size_t at(Tensor x) { return static_cast<std::size_t>(x.node()->id); }

  Graph& g_;
  const int first_, count_;
  std::vector<bool> whole_;
  std::map<std::pair<const Node*, int>, Tensor> made_;
  Tensor result_;
};

}  // namespace

Tensor compute_tokens(Graph& g, Tensor y, int first, int count) { return Narrowing(g, y, first, count).result(); }

}  // namespace vla
