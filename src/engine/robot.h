// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "engine/leftover.h"
#include "engine/noise.h"
#include "engine/plan.h"
#include "engine/solver.h"
#include "engine/taps.h"
#include "engine/timing.h"
#include "processor/processor.h"

namespace vla {

class Robot;

/// The key of an act's plan: the robot's tag, empty if the bundle is for one robot, and the size of the inputs.
struct ActShape {
  std::string embodiment;
  InputShape inputs;
  auto operator<=>(const ActShape&) const = default;
};

/// One observation as the host prepares it for the device. Vectors keep their memory when refilled.
struct EncodedObservation {
  const Robot* robot = nullptr;  // the robot that the observation names
  Inputs inputs;
  std::vector<float> noise;  // the solver's start, then the noise of each step that adds some
  std::optional<Steering> steering;
  Timing timing;
  std::unique_ptr<Device::Sent> pixels_ahead;  // the pixels on the device, if they were sent ahead
  std::function<bool()> is_late;               // called before each token: whether the deadline has passed
};

/// The answer to one observation.
struct ActionChunk {
  int horizon = 0;  // rows
  int d_action = 0;
  std::vector<float> actions;      // (horizon, d_action) in the robot's own units
  std::vector<float> normalized;   // the same before unnormalization, for a Leftover
  std::vector<std::string> notes;  // warnings about this answer
  bool out_of_range = false;       // whether a note says that state or leftover is out of range
  Timing timing;
  std::vector<Tap> taps;
};

/// One robot of a bundle: its keys and statistics, processor, policy and solver, and the values that the policy
/// computes from weights and times only. It does not change after it is loaded, so any thread may encode observations.
class Robot {
 public:
  /// `bundle` is reduced to one robot. `other` is an earlier robot of the same file, which shares parameters and
  /// tokenizer, or null. Errors: bad_bundle, unsupported.
  static Result<std::unique_ptr<Robot>> open(Bundle bundle, const Robot* other);
  /// Load rate: computes the values that every plan starts from. The parameters must be on the device. Errors:
  /// bad_bundle, unsupported, out_of_memory, device.
  Status compute_constants(const PlanContext& context);
  /// Removes the tokenizer's keys, which are needed only to compare later robots with this one.
  void forget_tokenizer() { bundle_.forget("tokenizer."); }
  /// Declares that no observation has this view, so that observations need not mention it. Errors: usage.
  Status declare_absent(const std::string& view) { return processor_.declare_absent(view); }
  /// Changes the number of solver steps. The robot must have no plans. Errors: bad_bundle, out_of_memory, device.
  Status set_steps(int n_step, Device& device, bool dry);

  /// Fills everything in `to` except its robot. `run` executes the parts of image preprocessing, possibly in parallel.
  /// Errors: bad_observation, unsupported, out_of_memory.
  Status encode(const Observation& observation, const Noise& noise, const std::optional<Leftover>& leftover,
                EncodedObservation& to, const RunItems& run = one_by_one) const;
  /// An encoded observation of this size, filled with zeros. Errors: bad_observation if no observation has this size.
  Result<EncodedObservation> zeros(const InputShape& shape) const;
  /// Turns the network's answer, (solver_horizon, d_action_padded) or tokens, into the robot's rows and columns, with
  /// notes. Errors: bad_action.
  Result<ActionChunk> decode(const std::vector<float>& answer, const Inputs& inputs) const;

  const Bundle& bundle() const { return bundle_; }
  const Processor& processor() const { return processor_; }
  const Solver& solver() const { return solver_; }
  const ParamList& params() const { return params_; }
  Network network() const { return {*policy_, solver_, conditions_, constants_, d_action_, horizon_}; }
  InputShape largest_shape() const;
  InputShape shape_of(const EncodedObservation& observation) const;
  /// How an act uses a leftover. None if actions are relative to a state, because a leftover does not contain that
  /// state.
  RealTimeChunking real_time_chunking() const;
  /// Rows of a chunk.
  int horizon() const { return processor_.n_row(horizon_); }
  /// Rows of the network's chunk; at least `horizon()`.
  int solver_horizon() const { return horizon_; }
  /// Rows of the noise, which has as many columns as the network's chunk: the solver's start, then as many rows for
  /// each step that adds noise.
  int noise_rows() const { return horizon_ * solver_.n_noise(); }
  int d_action_padded() const { return d_action_; }
  /// Bytes of the values that are computed at load.
  std::size_t constants_size() const { return tables_.size() + constant_slots_.size(); }

 private:
  Robot(Bundle bundle, Processor processor, const Robot* other);
  Status read_policy();
  Status make_conditions(const PlanContext& context);
  Status check_leftover(const Observation& observation, const Leftover& leftover, Inputs& inputs) const;
  ChunkShape chunk_shape() const;
  std::uint64_t view_key(std::uint64_t views) const;
  Result<std::vector<float>> values_of(const Noise& noise) const;
  Result<std::vector<float>> normalized_chunk(const std::vector<float>& answer, std::string& note) const;

  Bundle bundle_;
  Processor processor_;
  ParamList params_;
  std::unique_ptr<Policy> policy_;
  Solver solver_;
  int horizon_ = 0, d_action_ = 0, d_state_ = 0;
  Slots tables_, constant_slots_;
  const Slot* conditions_ = nullptr;  // in tables_
  Cache constants_;                   // its slots are in constant_slots_
};

}  // namespace vla
