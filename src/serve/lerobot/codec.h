// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <set>

#include "serve/lerobot/pickle.h"
#include "serve/names.h"
#include "wire/vla.pb.h"

namespace vla::serve::lerobot {

/// LeRobot's names for a policy: `observation.images.X` and `observation.state`, unless `given` maps another feature to
/// one. Errors: usage, also for a policy without exactly one state.
Result<Names> lerobot_names(Given given, const v1::Description& description);

/// A robot's setup, sent before its first observation: its cameras, and which readings form the state.
struct Setup {
  struct Camera {
    std::string key;            // the camera's key in an observation
    const Names::Entry* entry;  // the policy's view
  };
  std::vector<std::string> motors;  // in the order of the state
  std::vector<Camera> cameras;
  std::int64_t n_action = 0;  // maximum rows of a chunk
};
/// Reads a pickled RemotePolicyConfig. Ignores the policy that it names, since the server serves its own. `names` must
/// outlive the setup. Errors: bad_request; bad_observation, listing both sides, if the cameras or the state's width do
/// not match.
Result<Setup> read_setup(std::span<const std::byte> message, const Names& names, const v1::Description& description);

/// Encodes a setup for `setup_of`. `names` must outlive the decoded one. Errors: bad_request.
std::string bytes_of(const Setup& setup);
Result<Setup> setup_of(std::string_view bytes, const Names& names);
bool is_same(const Setup& a, const Setup& b);

/// The fields of a pickled TimedObservation that are read before its images and text.
struct Observed {
  std::int64_t timestep = 0;
  double timestamp = 0;  // seconds, by the robot's clock
  bool must_go = false;
  std::vector<float> state;  // in the robot's units
  std::string module;        // Python module of its class; the answer uses the same
};
/// Errors: bad_request, bad_observation.
Result<Observed> read_observation(const pickle::Pickle& message, const Setup& setup);

/// Makes the act. `limits`: from the description. Errors: bad_observation, too_large.
Result<v1::Act> act_of(const pickle::Pickle& message, const Observed& observed, const Setup& setup, const Names& names,
                       const v1::Limits& limits);

/// Encodes a pickled list of TimedAction, each with a float32 torch tensor; row i has the observation's timestep + i.
/// `period`: seconds between rows.
std::string encode_actions(const v1::ActionChunk& chunk, const Observed& observed, const Setup& setup,
                           const Names& names, double period);

/// Decides which observations of a robot are computed, by the reference's rules.
class Filter {
 public:
  /// Forgets the computed timesteps because the robot starts over; keeps the last computed observation.
  void begin() { computed_.clear(); }
  /// Whether an observation is computed: always if it says must_go or is the first; else if its timestep has no chunk
  /// yet and its state differs by at least 1, in the robot's units, from that of the last computed one.
  bool takes(const Observed& observed) const;
  void computes(const Observed& observed);

 private:
  std::set<std::int64_t> computed_;  // timesteps
  std::optional<std::vector<float>> last_;
};

}  // namespace vla::serve::lerobot
