// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lower/cuda/cuda_queue.h"

namespace vla::lower {

/// Merges independent operations of a phase into one kernel: strips and Hopper's tiles of products with the same rows,
/// depth and shares of it, and rows of heads, as of q, k and v. n_sm: blocks that run at a time.
void merge_calls(std::vector<Calls>& phase, int n_sm);

}  // namespace vla::lower
