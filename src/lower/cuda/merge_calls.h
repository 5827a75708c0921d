// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lower/cuda/cuda_queue.h"

namespace vla::lower {

/// Merges independent operations of a phase, such as those of q, k and v, into one kernel: products in strips or Hopper
/// tiles with equal rows, depth and shares, and operations on rows of heads. n_sm: SMs of the device.
void merge_calls(std::vector<Calls>& phase, int n_sm);

}  // namespace vla::lower
