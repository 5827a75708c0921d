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

/// What an act's plan is made for: the robot's tag, empty where a bundle is for one, and the size of the inputs.
struct ActShape {
  std::string embodiment;
  InputShape inputs;
  auto operator<=>(const ActShape&) const = default;
};

/// The host's part of one observation, made before the device is needed. Vectors keep their memory when filled again.
struct EncodedObservation {
  const Robot* robot = nullptr;  // the robot that the observation names
  Inputs inputs;
  std::vector<float> noise;  // what the solver starts from, and what it draws for steps
  std::optional<Steering> steering;
  Timing timing;
  std::unique_ptr<Device::Sent> pixels_ahead;  // if the pixels are on their way to the device already
  std::function<bool()> is_late;               // asked before each token: whether nobody wants the answer any more
};

/// The answer to one observation.
struct ActionChunk {
  int horizon = 0;  // rows
  int d_action = 0;
  std::vector<float> actions;      // (horizon, d_action) in the robot's own units
  std::vector<float> normalized;   // before unnormalization, as a Leftover takes it
  std::vector<std::string> notes;  // warnings about this answer
  bool out_of_range = false;       // whether one of them says that the state is out of range
  Timing timing;
  std::vector<Tap> taps;
};

/// One robot of a bundle: its keys and statistics, processor, policy and solver, and what the policy computes from
/// weights and times only. It does not change after it is loaded, so any thread may encode observations.
class Robot {
 public:
  /// `bundle` is that of one robot. `other` is an earlier robot of the same file, which shares parameters and
  /// tokenizer, or null. Errors: bad_bundle, unsupported.
  static Result<std::unique_ptr<Robot>> open(Bundle bundle, const Robot* other);
  /// Load rate: computes what every plan starts from. The device must have the parameters. Errors: bad_bundle,
  /// unsupported, out_of_memory, device.
  Status compute_constants(const PlanContext& context);
  /// Removes keys that were kept to compare later robots with.
  void forget_tokenizer() { bundle_.forget("tokenizer."); }
  /// Removes a view that this robot does not have from what observations must give. Errors: usage.
  Status declare_absent(const std::string& view) { return processor_.declare_absent(view); }
  /// Changes the number of solver steps. The robot must have no plans. Errors: bad_bundle, out_of_memory, device.
  Status set_steps(int n_step, Device& device, bool dry);

  /// Fills everything in `to` except its robot; `run` prepares parts of the images. Errors: bad_observation,
  /// unsupported, out_of_memory.
  Status encode(const Observation& observation, const Noise& noise, const std::optional<Leftover>& leftover,
                EncodedObservation& to, const RunItems& run = one_by_one) const;
  /// The same of zeros, of this size. Errors: bad_observation where no observation has it.
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
  /// How an act uses a leftover. None if actions are relative to a state, because the rows no longer know theirs.
  RealTimeChunking real_time_chunking() const;
  /// Rows of a chunk.
  int horizon() const { return processor_.n_row(horizon_); }
  /// Rows and columns of the network's chunk: those of the robot's, or more.
  int solver_horizon() const { return horizon_; }
  /// Rows of the noise, as wide as the network's chunk: the solver's start, then as many for each step that draws.
  int noise_rows() const { return horizon_ * solver_.n_noise(); }
  int d_action_padded() const { return d_action_; }
  /// Bytes that were computed at load.
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
  Cache constants_;                   // its index in constant_slots_
};

}  // namespace vla
