// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "engine/solver.h"
#include "policies/policy.h"

namespace vla {

/// Real-time chunking: rows of the previous chunk that the robot has not executed at the time of the observation. The
/// next chunk continues them.
struct Leftover {
  std::vector<float> rows;  // the last rows of ActionChunk::normalized, in its columns
  int delay = 0;            // how many of them the robot will have executed when the next chunk arrives
  /// Required for a guided policy, refused for others: how a row's weight falls after `delay` (zeros, ones, linear or
  /// exp), and the largest weight of the guidance.
  std::string schedule;
  std::optional<double> max_guidance;
};

/// "guided", "inpainted", or empty for none.
const char* kind_name(RealTimeChunking::Kind kind);

/// How a Leftover changes a solve: it replaces the start, and at every step k, in every row r, the velocity v by keep *
/// v + pull * (x - target).
struct Steering {
  std::vector<float> start;       // (horizon, d_action)
  std::vector<float> target;      // the leftover, padded with zeros: (horizon, d_action)
  std::vector<float> keep, pull;  // (n_step, horizon)
};

/// The sizes of a solve and of a chunk's rows.
struct ChunkShape {
  int horizon, d_action;    // rows and columns that the network computes
  int n_row, d_normalized;  // rows and columns of ActionChunk::normalized
};

/// Computes the steering from the solver's noise `start`. For a guided policy, every step pulls the chunk towards the
/// rows. An inpainted policy starts from the rows, freezes the first `delay`, and lets later rows change more the
/// further they are from the frozen ones. In the reference the velocity is computed before its gradient is enabled, so
/// the correction is the weighted error itself. Source: lerobot policies/rtc/modeling_rtc.py RTCProcessor.denoise_step,
/// get_prefix_weights; policies/groot/groot_n1_7.py get_action_with_features. Errors: unsupported (the policy cannot),
/// bad_observation.
Result<Steering> steer(const RealTimeChunking& rtc, const Solver& solver, const Leftover& leftover,
                       const ChunkShape& shape, std::vector<float> start);

}  // namespace vla
