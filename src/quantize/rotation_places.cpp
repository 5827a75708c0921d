// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/rotation_places.h"

#include <algorithm>
#include <numeric>

#include "quantize/graphs.h"
#include "quantize/matrix_inputs.h"

namespace vla {
namespace {

constexpr std::int64_t kLeastRotated = 16;  // fewer channels have little to share

/// Whether a node only moves whole tokens, or appends them to each other.
bool keeps_tokens_whole(const Node& node) {
  if (node.as<op::PixelShuffle>() != nullptr || is_view_of_channels(node)) return true;
  if (const auto* permute = node.as<op::Permute>()) return permute->order[0] == 0;
  return node.as<op::Reshape>() != nullptr && node.shape[0] % node.in[0].dim(0) == 0;
}

/// The gain of the product y in y * gain, if nothing else reads y; else null.
const Param* gain_of_product(const Node& node, const Readers& readers) {
  if (node.as<op::Multiply>() == nullptr) return nullptr;
  const Node &y = *node.in[0].node(), &by = *node.in[1].node();
  const bool is_one_token = by.shape == Shape{y.shape[0], 1, 1, 1};
  const auto* product = y.as<op::Linear>();
  const bool is_of_floats = product != nullptr && product->rule == op::Rule::floats;
  return is_of_floats && readers.at(&y).size() == 1 && is_one_token ? parameter_of(by) : nullptr;
}

}  // namespace

/// Follows the channels of each node's operands into its result.
struct Follower {
  RotationPlaces& places;
  const Readers& readers;
  std::vector<int> ids;                              // of each node's value
  std::map<const Node*, const Param*> gain_of_read;  // by product
  std::map<const Node*, const Param*> gain_of_made;
  const Node* node = nullptr;

  int id_of(const Tensor& tensor) const { return ids[static_cast<std::size_t>(tensor.node()->id)]; }
  int in(std::size_t i) const { return id_of(node->in[i]); }
  int out() const { return ids[static_cast<std::size_t>(node->id)]; }
  void join(std::size_t i) { places.join(out(), in(i)); }
  void join_all() {
    for (std::size_t i = 0; i < node->in.size(); ++i) join(i);
  }
  void fix_all() {
    places.fix(out());
    for (const Tensor& tensor : node->in) places.fix(id_of(tensor));
  }

  void operator()(const op::Input& op) { places.join(out(), places.id_of(op.slot)); }
  void operator()(const op::Constant&) {
    if (!is_zeros(*node)) places.fix(out());
  }
  void operator()(const op::Parameter& op) { read_rows(op.param); }
  void operator()(const op::Linear& op) {
    places.join(in(0), places.id_of(op.weight, 0));
    places.join(out(), places.id_of(op.weight, 1));
    if (op.rule != op::Rule::floats) fix_all();
    if (op.bias != nullptr) places.join(out(), places.id_of(op.bias, 0));
    note_gains(op);
  }
  void operator()(const op::Embedding& op) { read_rows(op.table); }
  void operator()(const op::Gather&) { join(0); }
  void operator()(const op::Norm&) {
    join(0);
    if (std::string& path = places.values_of(out()).path; path.empty()) path = node->path;
    if (node->in.size() == 1) return;
    const bool has_bias = node->in.size() > 2;
    const Param* const gain = parameter_of(*node->in[1].node());
    const Param* const bias = has_bias ? parameter_of(*node->in[2].node()) : nullptr;
    std::vector<const Node*> products;
    const bool can_fold =
        gain != nullptr && has_bias == (bias != nullptr) && find_products(*node, readers, keeps_tokens_whole, products);
    for (const Param* vector : {gain, bias}) note_rows(vector, can_fold ? gain : nullptr);
    if (!can_fold) return fix_all();
    if (has_bias) join(2);
    FoldedGain& folded = fold(gain);
    if (folded.bias != nullptr && folded.bias != bias) note_rows(gain, nullptr);
    folded.bias = bias;
    for (const Node* product : products) {
      folded.columns.insert(product->as<op::Linear>()->weight);
      gain_of_read[product] = gain;
    }
  }
  void operator()(const op::Rope&) { fix_all(); }
  void operator()(const op::Attention& op) {
    places.fix(in(0));
    const std::size_t first = op.has_mask ? 2 : 1;
    for (std::size_t i = first; i < node->in.size(); i += 2) {
      places.fix(in(i));
      join(i + 1);
    }
    places.values_of(out()).is_heads = true;
  }
  void operator()(const op::Activate&) { fix_all(); }
  void operator()(const op::Add&) { node->in[1].dim(0) == node->shape[0] ? join_all() : fix_all(); }
  void operator()(const op::Multiply&) {
    if (const Param* gain = gain_of_product(*node, readers)) {
      join(0);
      const Node& product = *node->in[0].node();
      const auto& linear = *product.as<op::Linear>();
      note_rows(gain, gain);
      FoldedGain& folded = fold(gain);
      folded.rows.insert(linear.weight);
      if (linear.bias != nullptr) folded.rows.insert(linear.bias);
      gain_of_made[&product] = gain;
    } else if (node->in[1].dim(0) == 1) {
      join(0);
      places.fix(in(1));
    } else {
      fix_all();
    }
  }
  void operator()(const op::Scale&) { join(0); }
  void operator()(const op::Concat&) { join_all(); }
  void operator()(const op::Slice& op) {
    join(0);
    if (op.dim == 0) places.narrow(out(), op.first);
  }
  void operator()(const op::Repeat&) { node->in[0].dim(0) == node->shape[0] ? join_all() : fix_all(); }
  void operator()(const op::Reshape&) { join(0); }
  void operator()(const op::Permute& op) { op.order[0] == 0 ? join_all() : fix_all(); }
  void operator()(const op::Patches&) { fix_all(); }
  void operator()(const op::PixelShuffle&) { join(0); }
  void operator()(const op::Unfold&) { fix_all(); }
  void operator()(const op::MaxPool&) { fix_all(); }
  void operator()(const op::Depthwise&) { fix_all(); }
  void operator()(const op::ChannelAttention&) { fix_all(); }
  void operator()(const op::Write& op) { places.join(in(0), places.id_of(op.slot)); }

  FoldedGain& fold(const Param* gain) {
    RotationPlaces::Fold& made = places.folds_.try_emplace(gain, RotationPlaces::Fold{out(), {gain}}).first->second;
    places.join(made.id, out());
    return made.folded;
  }
  /// Handles a node that returns a vector or rows of a table. A product may not rotate or scale these rows.
  void read_rows(const Param* table) {
    places.join(out(), places.id_of(table, 0));
    if (table->shape.size() == 1) return;
    places.fix(places.id_of(table, 1));
    places.columns_of_[table].insert(nullptr);
    note_rows(table, nullptr);
  }
  void note_rows(const Param* param, const Param* gain) {
    if (param != nullptr) places.rows_of_[param].insert(gain);
  }
  void note_gains(const op::Linear& op) {
    const auto gain_in = [&](const auto& gains) {
      const auto found = gains.find(node);
      return found != gains.end() ? found->second : nullptr;
    };
    if (!is_zeros(*node->in[0].node())) places.columns_of_[op.weight].insert(gain_in(gain_of_read));
    for (const Param* made : {op.weight, op.bias}) note_rows(made, gain_in(gain_of_made));
  }
  /// Notes the vectors that the node reads, but for those of a gain's own use.
  void note_vectors() {
    const bool has_gain = node->as<op::Norm>() != nullptr || gain_of_product(*node, readers) != nullptr;
    for (std::size_t i = 0; i < node->in.size(); ++i)
      if (i == 0 || !has_gain) note_rows(parameter_of(*node->in[i].node()), nullptr);
  }
};

int RotationPlaces::add(std::int64_t d) {
  const int id = static_cast<int>(values_.size());
  values_.push_back({.parent = id, .d = d});
  return id;
}

int RotationPlaces::root(int id) const {
  while (values_[static_cast<std::size_t>(id)].parent != id) id = values_[static_cast<std::size_t>(id)].parent;
  return id;
}

void RotationPlaces::join(int a, int b) {
  const auto [first, second] = std::minmax({root(a), root(b)});
  if (first == second) return;
  Values &to = values_of(first), &of = values_of(second);
  of.parent = first;
  to.d = std::gcd(to.d, of.d);
  to.is_fixed = to.is_fixed || of.is_fixed;
  to.is_heads = to.is_heads || of.is_heads;
  if (to.path.empty()) to.path = of.path;
}

void RotationPlaces::narrow(int id, std::int64_t d) {
  Values& values = values_of(id);
  values.d = std::gcd(values.d, d);
}

int RotationPlaces::id_of(const Param* param, int dimension) {
  const auto [found, is_new] = params_.try_emplace({param, dimension}, 0);
  if (is_new) {
    found->second = add(param->shape[static_cast<std::size_t>(dimension)]);
    if (!is_float(*param)) fix(found->second);
  }
  return found->second;
}

int RotationPlaces::id_of(const Slot* slot) {
  const auto [found, is_new] = slots_.try_emplace(slot, SlotUse{});
  if (is_new) found->second.id = add(slot->shape[0]);
  return found->second.id;
}

void RotationPlaces::see(const Graph& graph) {
  const Readers readers = readers_of(graph);
  Follower follower = {.places = *this, .readers = readers};
  std::set<const Slot*> read, written;
  for (const Node& node : graph.nodes()) {
    follower.ids.push_back(add(node.shape[0]));
    if (const auto* input = node.as<op::Input>()) read.insert(input->slot);
    if (const auto* write = node.as<op::Write>()) written.insert(write->slot);
  }
  // Products come after what they read and before what multiplies them, so gains are noted when all are known.
  for (const Node& node : graph.nodes()) {
    follower.node = &node;
    if (node.as<op::Linear>() == nullptr) std::visit(follower, node.op);
    follower.note_vectors();
  }
  for (const Node& node : graph.nodes()) {
    follower.node = &node;
    if (node.as<op::Linear>() != nullptr) std::visit(follower, node.op);
  }
  for (const Slot* slot : read) slots_[slot].is_read = true;
  for (const Slot* slot : written) {
    SlotUse& use = slots_[slot];
    use.is_written = true;
    use.is_both_in_one_graph = use.is_both_in_one_graph || read.contains(slot);
  }
}

/// Returns a copy in which everything is fixed that only all graphs together can tell must not be rotated.
RotationPlaces RotationPlaces::with_conditions() const {
  RotationPlaces all = *this;
  // What one graph writes for another is the graphs' own; the caller sees all other slots.
  for (const auto& [slot, use] : slots_)
    if (!use.is_read || !use.is_written || use.is_both_in_one_graph) all.fix(use.id);
  for (const auto& [gain, fold] : folds_) {
    const std::set<const Param*> only = {gain};
    const auto have_only_it = [&](const std::set<const Param*>& params, const Gains& gains) {
      return std::ranges::all_of(params, [&](const Param* one) { return gains.at(one) == only; });
    };
    std::set<const Param*> rows = fold.folded.rows;
    rows.insert(gain);
    if (fold.folded.bias != nullptr) rows.insert(fold.folded.bias);
    if (!have_only_it(fold.folded.columns, columns_of_) || !have_only_it(rows, rows_of_)) all.fix(fold.id);
  }
  return all;
}

std::vector<RotationPlace> RotationPlaces::found() const {
  const RotationPlaces all = with_conditions();
  std::map<int, RotationPlace> by_root;
  for (const auto& [key, id] : params_) {
    const auto& [param, dimension] = key;
    RotationPlace& place = by_root[all.root(id)];
    (dimension == 0 ? place.elements : place.rows).insert(param);
  }
  for (const auto& [gain, fold] : folds_) by_root[all.root(fold.id)].folded.push_back(fold.folded);
  std::vector<RotationPlace> found;
  for (auto& [root, place] : by_root) {
    const Values& values = all.values_[static_cast<std::size_t>(root)];
    const bool is_read = std::ranges::any_of(place.elements, [](auto* p) { return p->storage == Storage::matrix; });
    if (values.is_fixed || values.d < kLeastRotated || place.rows.empty() || !is_read) continue;
    place.path = values.path;
    place.is_heads = values.is_heads, place.d = values.d;
    found.push_back(std::move(place));
  }
  return found;
}

}  // namespace vla
