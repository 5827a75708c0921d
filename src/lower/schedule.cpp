// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <map>

#include "lower/lowering.h"

namespace vla::lower {
namespace {

/// Marks steps that depend on no varying slot as invariant.
void find_invariants(const Lowering& l, const std::vector<Step*>& steps) {
  const auto& varying = l.options.varying;
  std::vector<bool> varies(l.values.size(), false);
  for (const Node& node : l.graph.nodes())
    if (const auto* input = node.as<op::Input>())
      varies[static_cast<std::size_t>(node.id)] = std::ranges::find(varying, input->slot) != varying.end();
  const auto changes = [&](ValueId id) { return varies[static_cast<std::size_t>(l.value(id).base)]; };
  const auto is_slot = [&](ValueId id) { return l.base(id).placement == Value::Placement::slot; };
  for (Step* step : steps) {
    step->invariant =
        !varying.empty() && std::ranges::none_of(step->reads, changes) && std::ranges::none_of(step->writes, is_slot);
    for (const ValueId id : step->writes) varies[static_cast<std::size_t>(id)] = !step->invariant;
  }
}

/// The last phase that reads a slot, and the last that writes it; -1: none.
struct SlotUse {
  int read = -1, written = -1;
};

/// Gives each step the first phase after those that compute its operands, and after conflicting accesses to the slots
/// that it reads or writes. Stages follow each other.
int schedule_part(Lowering& l, const std::vector<Step*>& steps, bool invariant, int first) {
  std::map<const Slot*, SlotUse> slots;
  const auto use_of = [&](ValueId id) -> SlotUse* {
    return l.base(id).placement == Value::Placement::slot ? &slots[l.base(id).slot] : nullptr;
  };
  int end = first, stage_first = first;
  std::size_t stage = 0;
  for (Step* step : steps) {
    if (step->invariant != invariant) continue;
    if (stage_of(l, *step) != stage) stage = stage_of(l, *step), stage_first = end;
    int phase = stage_first;
    for (const ValueId id : step->reads) {
      phase = std::max(phase, 1 + l.base(id).made);
      if (const SlotUse* use = use_of(id)) phase = std::max(phase, 1 + use->written);
    }
    for (const ValueId id : step->writes)
      if (const SlotUse* use = use_of(id)) phase = std::max({phase, 1 + use->read, 1 + use->written});
    step->phase = phase;
    end = std::max(end, phase + 1);
    for (const ValueId id : step->reads)
      if (SlotUse* use = use_of(id)) use->read = std::max(use->read, phase);
    for (const ValueId id : step->writes) {
      if (SlotUse* use = use_of(id)) use->written = std::max(use->written, phase);
      l.base(id).made = phase;
    }
  }
  return end;
}

}  // namespace

std::size_t stage_of(const Lowering& l, const Step& step) {
  const auto& stages = l.graph.stages();
  std::size_t i = 0;
  while (i < stages.size() && step.order >= static_cast<int>(stages[i].n_node)) ++i;
  return i;
}

void schedule(Lowering& l, std::vector<Step*> steps) {
  std::ranges::stable_sort(steps, {}, &Step::order);
  find_invariants(l, steps);
  l.n_prepare = schedule_part(l, steps, true, 0);
  l.n_phase = schedule_part(l, steps, false, l.n_prepare);
}

}  // namespace vla::lower
