// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <map>

#include "lower/lowering.h"

namespace vla::lower {
namespace {

/// What is computed from slots that do not vary stays the same.
void find_invariants(Lowering& l) {
  const auto& varying = l.options.varying;
  std::vector<bool> varies(l.values.size(), false);
  for (const Node& node : l.graph.nodes())
    if (const auto* input = node.as<op::Input>())
      varies[static_cast<std::size_t>(node.id)] =
          std::find(varying.begin(), varying.end(), input->slot) != varying.end();
  for (FusedOp& op : l.ops) {
    const bool changes = std::any_of(op.reads.begin(), op.reads.end(),
                                     [&](ValueId id) { return varies[static_cast<std::size_t>(l.value(id).base)]; });
    const bool stores = std::any_of(op.writes.begin(), op.writes.end(),
                                    [&](ValueId id) { return l.base(id).home == Value::Home::slot; });
    op.invariant = !varying.empty() && !changes && !stores;
    for (const ValueId id : op.writes) varies[static_cast<std::size_t>(id)] = !op.invariant;
  }
}

/// The last phases that read a slot, and that write it.
struct SlotUse {
  int read = -1, written = -1;
};

/// The first phase behind all that an operation needs, and behind those who read or write a slot before it does. Stages
/// follow each other.
int schedule_part(Lowering& l, bool invariant, int first) {
  std::vector<int> made(l.values.size(), first - 1);  // the phase that makes a value
  std::map<const std::byte*, SlotUse> slots;
  const auto use_of = [&](ValueId id) -> SlotUse* {
    return l.base(id).home == Value::Home::slot ? &slots[l.base(id).data] : nullptr;
  };
  int end = first, stage_first = first;
  std::size_t stage = 0;
  for (FusedOp& op : l.ops) {
    if (op.invariant != invariant) continue;
    if (stage_of(l, op) != stage) stage = stage_of(l, op), stage_first = end;
    int phase = stage_first;
    for (const ValueId id : op.reads) {
      phase = std::max(phase, 1 + made[static_cast<std::size_t>(l.value(id).base)]);
      if (const SlotUse* use = use_of(id)) phase = std::max(phase, 1 + use->written);
    }
    for (const ValueId id : op.writes)
      if (const SlotUse* use = use_of(id)) phase = std::max({phase, 1 + use->read, 1 + use->written});
    op.phase = phase;
    end = std::max(end, phase + 1);
    for (const ValueId id : op.reads)
      if (SlotUse* use = use_of(id)) use->read = std::max(use->read, phase);
    for (const ValueId id : op.writes) {
      if (SlotUse* use = use_of(id)) use->written = std::max(use->written, phase);
      made[static_cast<std::size_t>(l.value(id).base)] = phase;
    }
  }
  return end;
}

}  // namespace

std::size_t stage_of(const Lowering& l, const FusedOp& op) {
  const auto& stages = l.graph.stages();
  std::size_t i = 0;
  while (i < stages.size() && op.order >= static_cast<int>(stages[i].n_node)) ++i;
  return i;
}

void schedule(Lowering& l) {
  std::stable_sort(l.ops.begin(), l.ops.end(), [](const FusedOp& a, const FusedOp& b) { return a.order < b.order; });
  find_invariants(l);
  l.n_prepare = schedule_part(l, true, 0);
  l.n_phase = schedule_part(l, false, l.n_prepare);
  std::stable_sort(l.ops.begin(), l.ops.end(), [](const FusedOp& a, const FusedOp& b) { return a.phase < b.phase; });
}

}  // namespace vla::lower
