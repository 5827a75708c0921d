// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/smoothing_places.h"

#include <algorithm>

#include "quantize/matrix_inputs.h"

namespace vla {
namespace {

using Readers = std::map<const Node*, std::vector<const Node*>>;

Readers readers_of(const Graph& graph) {
  Readers readers;
  for (const Node& node : graph.nodes())
    for (const Tensor in : node.in) readers[in.node()].push_back(&node);
  return readers;
}

/// Collects the products that read a value, also through views. False if anything else reads it.
bool find_products(const Node& value, const Readers& readers, std::vector<const Node*>& products) {
  const auto found = readers.find(&value);
  if (found == readers.end()) return true;
  return std::ranges::all_of(found->second, [&](const Node* reader) {
    if (is_view_of_channels(*reader)) return find_products(*reader, readers, products);
    const auto* linear = reader->as<op::Linear>();
    if (linear == nullptr || linear->rule != op::Rule::floats) return false;
    products.push_back(reader);
    return true;
  });
}

const Param* parameter_of(const Tensor& tensor) {
  const auto* leaf = tensor.node()->as<op::Parameter>();
  return leaf != nullptr ? leaf->param : nullptr;
}

/// Returns `up` of the product gate * up if nothing else reads it; else null.
const op::Linear* up_of(const Node& node, const Readers& readers) {
  if (node.as<op::Multiply>() == nullptr || node.in[0].shape() != node.in[1].shape()) return nullptr;
  const Node& up = *node.in[1].node();
  return readers.at(&up).size() == 1 ? up.as<op::Linear>() : nullptr;
}

/// Whether scaling by powers of two is exact in the matrix's dtype.
bool has_exponents(const Param& matrix) {
  return matrix.encoding.type == DType::f32 || matrix.encoding.type == DType::bf16;
}

}  // namespace

void SmoothingPlaces::see(const Graph& graph) {
  const Readers readers = readers_of(graph);
  std::map<const Node*, const Param*> read_from, rows_of;  // for each product, the weight of its place
  for (const Node& node : graph.nodes()) {
    SmoothingPlace place = {.path = node.path};
    if (node.as<op::Norm>() != nullptr && node.in.size() > 1) {
      place.weight = parameter_of(node.in[1]);
      if (node.in.size() > 2) place.bias = parameter_of(node.in[2]);
    } else if (const op::Linear* up = up_of(node, readers)) {
      place.weight = up->weight, place.bias = up->bias;
      rows_of[node.in[1].node()] = up->weight;
    }
    if (place.weight == nullptr) continue;
    std::vector<const Node*> products;
    const bool holds = !node.path.empty() && find_products(node, readers, products) && !products.empty() &&
                       (node.in.size() < 3 || place.bias != nullptr);
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
      if (const Param* vector = parameter_of(node.in[i]))
        rows_[vector].insert(node.as<op::Norm>() != nullptr ? parameter_of(node.in[1]) : nullptr);
  }
}

std::vector<SmoothingPlace> SmoothingPlaces::found() const {
  std::vector<SmoothingPlace> found;
  for (const auto& [weight, place] : places_) {
    const std::set<const Param*> itself = {place.weight};
    const auto is_only = [&](const Uses& uses, const Param* param) { return uses.at(param) == itself; };
    const bool reads_well = std::ranges::all_of(
        place.readers, [&](const Param* matrix) { return has_exponents(*matrix) && is_only(columns_, matrix); });
    const bool divides_well = is_only(rows_, weight) && (place.bias == nullptr || is_only(rows_, place.bias)) &&
                              (weight->storage == Storage::vector || has_exponents(*weight));
    if (!refused_.contains(weight) && reads_well && divides_well) found.push_back(place);
  }
  std::ranges::sort(found, {}, &SmoothingPlace::path);
  return found;
}

}  // namespace vla
