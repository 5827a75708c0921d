// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <set>

#include "engine/taps.h"
#include "graph/device.h"

namespace vla {

/// Values that replace those that a plan's two graphs compute at taps. Operations that are needed only for a replaced
/// value are not run.
class Injection {
 public:
  /// `given` may be null. `given` and `slots` must outlive this.
  Injection(const std::vector<Tap>* given, Slots& slots) : given_(given), slots_(slots) {}

  /// The injectors for recording a plan's two graphs. A value of the step's graph must be given for all `n_step` steps.
  Injector of_prefix();
  Injector of_step(int n_step);
  /// Call it after both graphs are recorded. Errors: bad_observation if a given value has a name that is in no graph,
  /// or a wrong shape.
  Status check() const;
  /// Writes the values of the prefix or of step k. The slots must have memory.
  void set(Device& device, int k) const;
  const std::vector<const Slot*>& slots() const { return filled_; }

 private:
  struct Place {
    const Slot* slot;
    std::vector<const Tap*> values;  // one per step, or one for all
  };
  const Slot* replace(const std::vector<std::string>& names, Tensor value);
  const Tap* find(const std::string& name) const;

  const std::vector<Tap>* given_;
  Slots& slots_;
  std::vector<Place> places_;
  std::vector<const Slot*> filled_;
  std::set<std::string> known_, used_;  // names in the graphs; names of given values found there
  Status problem_;
};

}  // namespace vla
