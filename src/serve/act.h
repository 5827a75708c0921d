// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "engine/engine.h"
#include "serve/options.h"

namespace vla::serve {

/// Limits of an act, checked before memory of the requested sizes is allocated.
struct ActLimits {
  std::int64_t max_pixels = 0;  // budget of all images together: pixels to decode and to fit
  std::size_t max_text = 0;     // bytes
  std::size_t max_views = 0;
  int horizon = 0;  // rows of the network's chunk
  int noise_rows = 0, d_noise = 0;
  int d_action = 0;          // columns of a chunk
  const Fit* fit = nullptr;  // the recipe's image ops
};

/// An act, decoded for the engine.
struct ActRequest {
  Observation observation;
  Noise noise;
  std::optional<std::uint64_t> seed;  // seed of the noise: the client's or a new one
  std::optional<Leftover> leftover;
  std::int64_t capture_time_ns = 0;
};

/// Checks that the bundle has one robot: clients of `option` cannot name one of several. Errors: usage.
Status check_one_robot(const Engine& engine, const char* option);

/// Limits for one robot's acts.
ActLimits act_limits(const ServerOptions& options, const Robot& robot);
/// Adds an image's cost to its act: `work` pixels for decoding, and the cost of fitting it. Errors: too_large.
Status spend(ActLimits& left, int width, int height, std::int64_t work, const std::string& where);

/// A new seed for an act without one.
std::uint64_t fresh_seed();

}  // namespace vla::serve
