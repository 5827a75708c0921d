// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/kernel_set.h"

#include <algorithm>
#include <iterator>

namespace vla {

std::vector<KernelSet> kernel_sets(Features machine) {
  std::vector<KernelSet> sets;
  std::copy_if(std::begin(kernel_set::all), std::end(kernel_set::all), std::back_inserter(sets),
               [&](const KernelSet& set) { return machine.has_all(set.needs); });
  return sets;
}

const std::vector<KernelSet>& usable_kernels() {
  static const std::vector<KernelSet> usable = kernel_sets(this_cpu());
  return usable;
}

const KernelSet& kernel_set_of(Features use) {
  const auto fits = [&](const KernelSet& set) { return use.has_all(set.needs); };
  return *std::find_if(std::rbegin(kernel_set::all), std::rend(kernel_set::all), fits);
}

}  // namespace vla
