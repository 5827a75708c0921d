// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {

/// A GPU's published figures without sparsity, at the clock of the maker's peak figures. Predictions for GPUs that are
/// not present use them.
struct GpuModel {
  const char *name, *description;
  int n_sm;
  bool is_hopper = false;  // whether Hopper kernels run
  double clock;            // Hz
  double bf16, int8;       // operations per second of the tensor units by mma.sync, summed in float32 and int32
  double f32, dot4;        // operations per second of float FMA, and of dp4a
  double bandwidth;        // bytes per second
  int shared;              // bytes of shared memory per SM
  double launch;           // seconds between two dependent kernels of a graph; on Hopper with a small kernel's own time
};

/// Errors: usage.
Result<GpuModel> find_gpu_model(const std::string& name);

/// Predicts the time of a program's phases. A phase takes the longer of two times: its products and attention in whole
/// waves of blocks, limited by the issue slots or tensor time of their main loops; and reading all operands once. The
/// launches and the smallest kernel's time are added. On Hopper, products and attention take times fitted to
/// measurements instead, and clusters an assumed one. Entries: see Program::predictions. n_launch: kernels per
/// operation.
std::vector<Program::Prediction> predict(const CudaLowering& l, const std::vector<int>& n_launch, const GpuModel& gpu);

}  // namespace vla::lower
