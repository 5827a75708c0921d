// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lower/cpu/cpu_program.h"

namespace vla::lower {

/// Which matrices stay in memory, so that all of `weights` takes at most `size` bytes, or as few as it can: those that
/// the step reads, since it is run several times an act, and of those that the prefix reads as many as there is room
/// for. What is streamed lies spread evenly over the prefix, so that it is read while other matrices are multiplied.
WeightPlan plan_streams(const CpuWeights& weights, const CpuProgram& prefix, const CpuProgram& step, std::size_t size);

}  // namespace vla::lower
