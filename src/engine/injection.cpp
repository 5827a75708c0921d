// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/injection.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>

#include "base/edit_distance.h"

namespace vla {
namespace {

/// Suggests the most similar names.
std::vector<std::string> nearest(const std::string& name, const std::set<std::string>& names) {
  constexpr std::size_t kShown = 3;
  std::vector<std::pair<std::size_t, std::string>> all;
  for (const std::string& other : names) all.emplace_back(edit_distance(name, other), other);
  std::sort(all.begin(), all.end());
  std::vector<std::string> first;
  for (std::size_t i = 0; i < std::min(kShown, all.size()); ++i) first.push_back(all[i].second);
  return first;
}

Error refused(const std::string& name, std::string expected, std::string found, std::string hint = {}) {
  return {Code::bad_observation, "injected " + name, std::move(expected), std::move(found), std::move(hint)};
}

Shape shape_of(const Tap& tap) {
  Shape shape = {1, 1, 1, 1};
  std::copy_n(tap.shape.begin(), std::min(tap.shape.size(), shape.size()), shape.begin());
  return shape;
}

}  // namespace

Injector Injection::of_prefix() {
  if (given_ == nullptr) return {};
  return [this](const std::string& path, Tensor value) { return replace({path}, value); };
}

Injector Injection::of_step(int n_step) {
  if (given_ == nullptr) return {};
  return [this, n_step](const std::string& path, Tensor value) {
    std::vector<std::string> names;
    for (int k = 0; k < n_step; ++k) names.push_back(fmt::format("step.{}.{}", k, path));
    return replace(names, value);
  };
}

const Tap* Injection::find(const std::string& name) const {
  const auto found = std::find_if(given_->begin(), given_->end(), [&](const Tap& tap) { return tap.path == name; });
  return found != given_->end() ? &*found : nullptr;
}

const Slot* Injection::replace(const std::vector<std::string>& names, Tensor value) {
  Place place = {};
  const auto refuse = [&](Error error) {
    if (problem_.ok()) problem_ = std::move(error);
    return nullptr;
  };
  for (const std::string& name : names) {
    known_.insert(name);
    const Tap* tap = find(name);
    if (tap == nullptr) continue;
    if (!used_.insert(name).second) return refuse(refused(name, "a name of one value", "one of several"));
    if (shape_of(*tap) != value.shape())
      return refuse(refused(name, "shape " + shape_text(value.shape()), shape_text(shape_of(*tap))));
    place.values.push_back(tap);
  }
  if (place.values.empty()) return nullptr;
  if (place.values.size() < names.size())
    return refuse(refused(place.values.front()->path, fmt::format("values of all {} steps", names.size()),
                          fmt::format("those of {}", place.values.size())));
  place.slot = slots_.add_f32(value.shape());
  filled_.push_back(place.slot);
  places_.push_back(std::move(place));
  return filled_.back();
}

Status Injection::check() const {
  if (given_ == nullptr || !problem_.ok()) return problem_;
  for (const Tap& tap : *given_)
    if (used_.count(tap.path) == 0)
      return refused(tap.path, "the name of a value that this observation has", "no such value",
                     fmt::format("the nearest are {}", fmt::join(nearest(tap.path, known_), ", ")));
  return {};
}

void Injection::set(Device& device, int k) const {
  for (const auto& [slot, values] : places_) {
    const std::vector<float>& numbers = values[values.size() > 1 ? static_cast<std::size_t>(k) : 0]->values;
    device.set(*slot, numbers.data(), numbers.size() * sizeof(float));
  }
}

}  // namespace vla
