// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {

/// A GPU's published figures without sparsity, at the clock of the maker's peak figures: the basis of predictions for
/// GPUs that are not present.
struct GpuModel {
  const char *name, *description;
  int n_sm;
  bool is_hopper = false;  // whether Hopper kernels run
  double clock;            // Hz
  double bf16, int8;       // operations per second of the tensor units by mma.sync, summed in float32 and int32
  double f32, dot4;        // operations per second of float FMA, and of dp4a
  double bandwidth;        // bytes a second
  int shared;              // bytes of shared memory per SM
  double launch;           // seconds between two dependent kernels of a graph; of Hopper with the smaller one's own
};

/// Errors: usage.
Result<GpuModel> find_gpu_model(const std::string& name);

/// Predicts the time of a program's phases. Products and attention take whole waves of blocks, limited by the issue
/// slots or tensor time of their main loops, or the time to read all operands once, whichever is longer; launches and
/// the smallest kernel's time are added. On Hopper products and attention take what fits of measurements say instead.
/// Entries: see Program::predictions. n_launch: kernels per operation.
std::vector<Program::Prediction> predict(const CudaLowering& l, const std::vector<int>& n_launch, const GpuModel& gpu);

}  // namespace vla::lower
