// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/smoothing_places.h"

#include <algorithm>

#include "quantize/graphs.h"
#include "quantize/matrix_inputs.h"

namespace vla {
namespace {

/// Returns `up` of the product gate * up if nothing else reads it; else null.
const op::Linear* up_of(const Node& node, const Readers& readers) {
  if (node.as<op::Multiply>() == nullptr || node.in[0].shape() != node.in[1].shape()) return nullptr;
  const Node& up = *node.in[1].node();
  return readers.at(&up).size() == 1 ? up.as<op::Linear>() : nullptr;
}

}  // namespace

void SmoothingPlaces::see(const Graph& graph) {
  const Readers readers = readers_of(graph);
  std::map<const Node*, const Param*> read_from, rows_of;  // for each product, the weight of its place
  for (const Node& node : graph.nodes()) {
    SmoothingPlace place = {.path = node.path};
    if (node.as<op::Norm>() != nullptr && node.in.size() > 1) {
      place.weight = parameter_of(*node.in[1].node());
      if (node.in.size() > 2) place.bias = parameter_of(*node.in[2].node());
    } else if (const op::Linear* up = up_of(node, readers)) {
      place.weight = up->weight, place.bias = up->bias;
      rows_of[node.in[1].node()] = up->weight;
    }
    if (place.weight == nullptr) continue;
    std::vector<const Node*> products;
    const bool holds = !node.path.empty() && find_products(node, readers, is_view_of_channels, products) &&
                       !products.empty() && (node.in.size() < 3 || place.bias != nullptr);
    if (!holds) refused_.insert(place.weight);
    SmoothingPlace& known = places_.try_emplace(place.weight, place).first->second;
    for (const Node* product : products) {
      known.readers.insert(product->as<op::Linear>()->weight);
      read_from[product] = place.weight;
    }
  }
  const auto or_null = [](const auto& map, const Node* node) {
    const auto found = map.find(node);
    return found != map.end() ? found->second : nullptr;
  };
  for (const Node& node : graph.nodes()) {
    if (const auto* linear = node.as<op::Linear>()) {
      if (!is_zeros(*node.in[0].node())) columns_[linear->weight].insert(or_null(read_from, &node));
      rows_[linear->weight].insert(or_null(rows_of, &node));
      if (linear->bias != nullptr) rows_[linear->bias].insert(or_null(rows_of, &node));
    }
    for (std::size_t i = 0; i < node.in.size(); ++i)
      if (const Param* vector = parameter_of(*node.in[i].node()))
        rows_[vector].insert(node.as<op::Norm>() != nullptr ? parameter_of(*node.in[1].node()) : nullptr);
  }
}

std::vector<SmoothingPlace> SmoothingPlaces::found() const {
  std::vector<SmoothingPlace> found;
  for (const auto& [weight, place] : places_) {
    const std::set<const Param*> itself = {place.weight};
    const auto is_only = [&](const Uses& uses, const Param* param) { return uses.at(param) == itself; };
    const bool reads_well = std::ranges::all_of(
        place.readers, [&](const Param* matrix) { return is_float(*matrix) && is_only(columns_, matrix); });
    const bool divides_well = is_only(rows_, weight) && (place.bias == nullptr || is_only(rows_, place.bias)) &&
                              (weight->storage == Storage::vector || is_float(*weight));
    if (!refused_.contains(weight) && reads_well && divides_well) found.push_back(place);
  }
  std::ranges::sort(found, {}, &SmoothingPlace::path);
  return found;
}

}  // namespace vla
