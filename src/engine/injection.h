// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <set>

#include "engine/taps.h"
#include "graph/device.h"

namespace vla {

/// Values that take the place of what the two graphs of a plan compute at their taps. What only led to a value that is
/// replaced is not computed at all.
class Injection {
 public:
  /// `given`, which may be null, and `slots` outlive this.
  Injection(const std::vector<Tap>* given, Slots& slots) : given_(given), slots_(slots) {}

  /// For the graphs of a plan, while they are recorded. Values of a step are given for every step.
  Injector of_prefix();
  Injector of_step(int n_step);
  /// When both are recorded. Errors: bad_observation, naming what has no place or a wrong shape.
  Status check() const;
  /// When slots have memory: the values of the prefix and of step k.
  void set(Device& device, int k) const;
  const std::vector<const Slot*>& slots() const { return filled_; }

 private:
  struct Place {
    const Slot* slot;
    std::vector<const Tap*> values;  // of each step, or one
  };
  const Slot* replace(const std::vector<std::string>& names, Tensor value);
  const Tap* find(const std::string& name) const;

  const std::vector<Tap>* given_;
  Slots& slots_;
  std::vector<Place> places_;
  std::vector<const Slot*> filled_;
  std::set<std::string> known_, used_;  // names of the graphs, and those that were given
  Status problem_;
};

}  // namespace vla
