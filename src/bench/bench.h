// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "bench/random_bundle.h"
#include "bench/report.h"

namespace vla::bench {

/// A measurement to make, and how often.
struct Request {
  std::string bundle;  // a file; empty: random weights
  std::string arch;    // of the random weights, at their published size
  DType dtype = DType::bf16;
  WorkloadSizes sizes;
  std::vector<int> steps;  // the report is of the last, and has a fit where there are several; empty: the bundle's own
  int n_round = 7, n_warmup = 1;
  int n_thread = 0;  // as EngineOptions has them
  std::string kernels, device, embodiment;
  std::size_t memory = 0;
};

/// The sizes of the random weights that stand in for a bundle.
RandomSizes random_sizes(const Request& request);

/// Measures the machine, then the policy, then the machine again. `accept` sees the conditions before the first round
/// and may refuse them. Errors: usage, out_of_memory, and those of Engine.
Result<Report> measure(const Request& request, const std::function<Status(const Conditions&)>& accept,
                       const Watcher& watcher);

}  // namespace vla::bench
