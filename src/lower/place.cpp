// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <functional>
#include <numeric>

#include "lower/lowering.h"

namespace vla::lower {
namespace {

/// The phases during which a value must stay in memory.
struct Lifetime {
  int first = 0, last = -1;
  bool overlaps(const Lifetime& other) const { return first <= other.last && other.first <= last; }
};

std::vector<Lifetime> find_lifetimes(const Lowering& l, const std::vector<Step*>& steps) {
  std::vector<Lifetime> lifetimes(l.values.size());
  const auto at = [&](ValueId id) -> Lifetime& { return lifetimes[static_cast<std::size_t>(l.value(id).base)]; };
  for (const Step* step : steps)
    for (const ValueId id : step->writes) at(id) = {step->phase, step->phase};
  for (const Step* step : steps)
    for (const ValueId id : step->reads) at(id).last = std::max(at(id).last, step->phase);
  for (const Node& node : l.graph.nodes())
    if (node.tapped)
      at(node.id).last = std::max(at(node.id).last, l.target.keeps_taps ? l.n_phase : l.there_in(node.id));
  return lifetimes;
}

}  // namespace

/// Places values, largest first, each at the lowest offset that is free throughout its lifetime. Constants follow the
/// kept values.
void place(Lowering& l, const std::vector<Step*>& steps) {
  const std::vector<Lifetime> lifetimes = find_lifetimes(l, steps);
  std::vector<std::size_t> order(l.values.size());
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::ranges::stable_sort(order, std::greater(), [&](std::size_t i) { return l.values[i].size; });
  struct Taken {
    Lifetime lifetime;
    std::size_t begin, end;
  };
  std::vector<Taken> taken;  // sorted by begin
  for (const std::size_t i : order) {
    Value& value = l.values[i];
    const Lifetime& lifetime = lifetimes[i];
    if (value.placement != Value::Placement::arena || value.base != static_cast<ValueId>(i) || lifetime.last < 0)
      continue;
    const std::size_t size = l.target.aligned(value.size);
    if (lifetime.first < l.n_prepare && lifetime.last >= l.n_prepare) {  // prepare computes it, runs read it
      value.placement = Value::Placement::kept;
      value.begin = l.kept_size;
      l.kept_size += size;
      continue;
    }
    std::size_t begin = 0;
    for (const Taken& other : taken)
      if (other.lifetime.overlaps(lifetime) && other.begin < begin + size && other.end > begin) begin = other.end;
    value.begin = begin;
    taken.insert(std::ranges::upper_bound(taken, begin, {}, &Taken::begin), Taken{lifetime, begin, begin + size});
    l.arena_size = std::max(l.arena_size, begin + size);
  }
  for (Value& value : l.values)
    if (value.placement == Value::Placement::constant)
      value.begin = l.kept_size, l.kept_size += l.target.aligned(value.size);
}

}  // namespace vla::lower
