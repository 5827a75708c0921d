// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <span>

#include "graph/device.h"

namespace vla::lower {

/// The matrices that an operation reads.
using OpMatrices = std::vector<const Param*>;
/// Those of the operations of each of some phases.
using MatrixReads = std::vector<std::vector<OpMatrices>>;

/// What an act reads, and how much of the device's memory that takes.
struct WeightUse {
  std::span<const std::vector<OpMatrices>> prepare, prefix, step;  // phases; of the prefix first those that run once
  std::function<std::size_t(const Param&)> size_of;                // bytes of a matrix
  std::size_t size;                                                // bytes of all parameters
};

/// Which matrices stay in memory, so that all parameters take at most `size` bytes, or as few as they can: those that
/// the step reads, since it is run several times an act, and of those that the prefix reads as many as there is room
/// for. What is streamed lies spread evenly over the prefix, so that it is read while other matrices are multiplied. No
/// operation of the prefix reads two of the groups, so that none is split and its values take the same memory.
WeightPlan plan_streams(const WeightUse& use, std::size_t size);

/// By Param::id, the group of the plan that a matrix is streamed in, or -1.
std::vector<int> groups_by_id(const WeightPlan& plan, std::size_t n_param);

}  // namespace vla::lower
