// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>

#include "bench/random_bundle.h"
#include "bench/report.h"

namespace vla::bench {

/// What to measure, and how often.
struct Request {
  std::string bundle;  // path of a bundle; empty: random weights
  std::string arch;    // architecture of the random weights, at its published size
  DType dtype = DType::bf16;
  WorkloadSizes sizes;
  std::vector<int> steps;  // solver steps; the report is on the last number; several add a fit; empty: the bundle's own
  int n_round = 7, n_warmup = 1;
  int n_thread = 0;  // see EngineOptions
  std::string kernels, device, embodiment;
  std::size_t memory = 0;
  std::optional<Roofs> roofs;  // of the machine, if they are known
};

/// The sizes of a bundle of random weights.
RandomSizes random_sizes(const Request& request);

/// Measures the machine, unless its roofs are known, then the policy, then the machine again. `accept` gets the
/// conditions before all this and may refuse them. Errors: usage, out_of_memory, and those of Engine.
Result<Report> measure(const Request& request, const std::function<Status(const Conditions&)>& accept,
                       const Watcher& watcher);

}  // namespace vla::bench
