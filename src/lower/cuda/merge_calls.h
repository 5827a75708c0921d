// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lower/cuda/cuda_queue.h"

namespace vla::lower {

/// Of a phase's operations, which do not depend on each other, strips of products with the same rows and depth become
/// one kernel, and so do rows of heads: q, k and v of attention. n_sm: blocks that run at a time.
void merge_calls(std::vector<Calls>& phase, int n_sm);

}  // namespace vla::lower
