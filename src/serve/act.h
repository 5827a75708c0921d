// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "engine/engine.h"
#include "serve/options.h"

namespace vla::serve {

/// The bounds of an act. All are compared before memory is taken that the sizes ask for.
struct ActLimits {
  std::int64_t max_pixels = 0;  // of all images, and what decoding and fitting them costs
  std::size_t max_text = 0;     // bytes
  std::size_t max_views = 0;
  int horizon = 0, d_noise = 0;  // of the noise that the policy takes
  int d_action = 0;              // of a chunk
  const Fit* fit = nullptr;      // that images go through
};

/// An act, ready for the engine.
struct ActRequest {
  Observation observation;
  Noise noise;
  std::optional<std::uint64_t> seed;  // that the noise is drawn from: the client's or a fresh one
  std::optional<Leftover> leftover;
  std::int64_t capture_time_ns = 0;
};

/// Errors: usage for a bundle of several robots, which `option`'s clients cannot name.
Status check_one_robot(const Engine& engine, const char* option);

/// The bounds for one robot's acts.
ActLimits act_limits(const ServerOptions& options, const Robot& robot);
/// An act costs what its images cost together: `work` of decoding this one, in pixels, and what fitting it takes.
/// Errors: too_large.
Status spend(ActLimits& left, int width, int height, std::int64_t work, const std::string& where);

/// The seed of an act whose client gave none.
std::uint64_t fresh_seed();

}  // namespace vla::serve
