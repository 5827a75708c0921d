// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <set>

#include "serve/lerobot/pickle.h"
#include "serve/names.h"
#include "wire/vla.pb.h"

namespace vla::serve::lerobot {

/// The names of LeRobot: a policy's own, `observation.images.X` and `observation.state`, unless a line gives one of
/// them another feature. Errors: usage, also for a policy that has not one state.
Result<Names> lerobot_names(Given given, const v1::Description& description);

/// A robot's set-up, sent before its first observation: how its readings become a state, and which cameras it has.
struct Setup {
  struct Camera {
    std::string key;            // in an observation
    const Names::Entry* entry;  // of the policy
  };
  std::vector<std::string> motors;  // in the order of the state
  std::vector<Camera> cameras;
  std::int64_t n_action = 0;  // rows of a chunk at most
};
/// A pickled RemotePolicyConfig. The policy that it names is not looked at: the server's own answers. `names` outlives
/// the set-up. Errors: bad_request; bad_observation with both lists where cameras or the state's width do not fit.
Result<Setup> read_setup(std::span<const std::byte> message, const Names& names, const v1::Description& description);

/// A set-up as bytes that `setup_of` reads again. `names` outlives what is read. Errors: bad_request.
std::string bytes_of(const Setup& setup);
Result<Setup> setup_of(std::string_view bytes, const Names& names);
bool is_same(const Setup& a, const Setup& b);

/// What a pickled TimedObservation says before its images and its text are looked at.
struct Observed {
  std::int64_t timestep = 0;
  double timestamp = 0;  // seconds, by the robot's clock
  bool must_go = false;
  std::vector<float> state;  // as the robot has it
  std::string module;        // of its classes
};
/// Errors: bad_request, bad_observation.
Result<Observed> read_observation(const pickle::Pickle& message, const Setup& setup);

/// The act that it is. `limits`: of the description. Errors: bad_observation, too_large.
Result<v1::Act> act_of(const pickle::Pickle& message, const Observed& observed, const Setup& setup, const Names& names,
                       const v1::Limits& limits);

/// The pickled list of TimedAction, each with a float32 tensor of torch: row i belongs to the observation's timestep +
/// i. `period`: seconds between rows.
std::string encode_actions(const v1::ActionChunk& chunk, const Observed& observed, const Setup& setup,
                           const Names& names, double period);

/// Which observations of a robot are computed: the reference's rules.
class Filter {
 public:
  /// A robot that begins again; what was last computed is still known.
  void begin() { computed_.clear(); }
  /// Whether it is computed: one that must go, the first one, and one whose timestep has no chunk yet and whose state
  /// is at least 1 away from that of the last one, in the robot's own units.
  bool takes(const Observed& observed) const;
  void computes(const Observed& observed);

 private:
  std::set<std::int64_t> computed_;  // timesteps
  std::optional<std::vector<float>> last_;
};

}  // namespace vla::serve::lerobot
