// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>

#include "graph/device.h"

namespace vla::lower {

/// The matrices that an operation reads.
using OpMatrices = std::vector<const Param*>;
/// For each phase, the matrices that its operations read.
using MatrixReads = std::vector<std::vector<OpMatrices>>;

/// The matrices that an act reads, and their size in the device's memory.
struct WeightUse {
  const MatrixReads &prefix, &step;
  std::size_t n_prepare;                             // phases of the prefix that run once
  std::function<std::size_t(const Param&)> size_of;  // bytes of a matrix
  std::size_t size;                                  // bytes of all parameters
};

/// Plans which matrices to stream, so that all parameters take at most `size` bytes, or as few as possible. The step's
/// matrices stay resident, because the step runs several times per act; as many of the prefix's matrices as fit stay
/// resident, too. The streamed groups are spread evenly over the prefix, so that they are read while other matrices are
/// multiplied. No operation of the prefix reads two groups: no operation is split, and values take the same memory.
WeightPlan plan_streams(const WeightUse& use, std::size_t size);

/// For each Param::id, the group of the plan that streams the matrix, or -1.
std::vector<int> groups_by_id(const WeightPlan& plan, std::size_t n_param);

}  // namespace vla::lower
