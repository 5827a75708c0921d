// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "bench/bench.h"

namespace vla::bench {

/// The predicted time of an act on a model of a GPU, by stage, from counted work and published rates. Nothing runs.
struct GpuPrediction {
  std::string policy, device, linear_kernels;
  int n_view = 0, n_text = 0, n_step = 0;
  std::size_t memory = 0;  // bytes: weights, plan and working memory
  StagePredictions stages;

  /// The sum of all stages.
  Program::Prediction total() const;
};

/// Predicts for the request's bundle, or for random weights; threads and rounds of the request are not used. Errors:
/// usage, and those of Engine::load.
Result<GpuPrediction> predict(const Request& request, const std::string& model);

/// to_text: for display. to_json: one JSON object on one line.
std::string to_text(const GpuPrediction& prediction);
std::string to_json(const GpuPrediction& prediction);

}  // namespace vla::bench
