// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "engine/leftover.h"
#include "engine/noise.h"
#include "engine/plan.h"
#include "engine/timing.h"
#include "graph/rounding.h"
#include "lower/open.h"
#include "processor/processor.h"

namespace vla {

struct EngineOptions {
  int n_thread = 0;         // 0: every core that the process may use
  std::string kernels;      // as open_device takes them; empty: the best that the machine has for the bundle's dtype
  std::string device;       // cpu, vulkan:N or cuda:N, as open_device takes them; empty: the CPU
  std::string tap_pattern;  // empty: nothing is recorded, and the graphs are the production graphs
  /// Values at taps that take the place of the computed ones: as the network's own, or as `pixels` and `state`.
  std::vector<Tap> inject = {};
  bool dry = false;             // reserve memory without filling it: sizes are exact, and `act` must not be called
  std::string embodiment = {};  // the robot, by its tag; empty where the bundle is for one
  bool all_robots = false;      // without a tag: every robot of a bundle of several
};

/// The answer to one observation.
struct ActionChunk {
  int horizon = 0;  // rows
  int d_action = 0;
  std::vector<float> actions;      // (horizon, d_action) in the robot's own units
  std::vector<float> normalized;   // before unnormalization: what a Leftover takes
  std::vector<std::string> notes;  // warnings about this answer
  bool is_beyond = false;          // one of them: the state is beyond the bundle's bound
  Timing timing;
  std::vector<Tap> taps;
};

class Engine;

/// What the host makes of one observation before the device is needed. Vectors keep their memory when filled again.
struct Prepared {
  const Engine* robot = nullptr;  // that the observation names
  Inputs inputs;
  std::vector<float> x;  // what the solver starts from
  std::optional<Steering> steering;
  Timing timing;
};

/// Memory by what it holds, in bytes: parameters and tables; inputs and cache of the plans; what graphs share while
/// they run.
struct MemoryUse {
  std::size_t weights = 0, plan = 0, working = 0;
  std::size_t total() const { return weights + plan + working; }
};

/// A loaded bundle, ready to act. It owns the loop that every architecture runs: prefix, cache, solver steps,
/// unnormalize. One thread at a time may call it, and another one `prepare`.
///
/// Where it has several robots, this is the first of them and keeps the others: they share weights and working memory.
class Engine {
 public:
  /// Opens, checks and loads a bundle, and builds the largest plan. Errors: io, bad_bundle, unsupported, out_of_memory,
  /// device.
  static Result<std::unique_ptr<Engine>> load(const std::string& path, const EngineOptions& options);

  /// What `device` of the options may name on this machine.
  static DeviceList devices() { return list_devices(); }

  /// Of all robots: from now on a state beyond the bundle's bound is refused, as Processor::refuse_beyond.
  void refuse_beyond();
  /// This robot and the others.
  std::vector<const Engine*> robots() const;
  /// The robot that answers to this tag; an empty one where there is one robot. Errors: bad_observation, with the tags
  /// that there are.
  Result<const Engine*> robot(const std::string& tag) const;
  /// Computes the chunk of the robot that the observation names. `leftover`: rows of the previous chunk that are not
  /// executed yet, which the new chunk continues. Errors: bad_observation, bad_action (a number that is not finite came
  /// out), unsupported, device, out_of_memory.
  Result<ActionChunk> act(const Observation& observation, const Noise& noise,
                          const std::optional<Leftover>& leftover = {}) noexcept;
  /// The two halves of it: the host's, and the device's with unnormalization. One thread may prepare an observation
  /// while another one acts on the one before. Errors: of the first bad_observation, unsupported and out_of_memory.
  Status prepare(const Observation& observation, const Noise& noise, const std::optional<Leftover>& leftover,
                 Prepared& to) const noexcept;
  Result<ActionChunk> act(Prepared& prepared) noexcept;

  /// Solves in another number of steps than the bundle asks for, to measure what a step costs. Errors: bad_bundle,
  /// out_of_memory, device.
  Status set_steps(int n_step);
  /// The program of the prefix or of a step for the largest observation, one line an operation: phase, kernel, MFLOP,
  /// MB, what is computed, and how its operand and results lie in memory. Errors: out_of_memory.
  enum class Part { prefix, step };
  Result<std::string> program_text(Part part);
  /// What the network computed for the last observation; empty before the first, and where its plan is gone.
  StageWork work() const;

  const Bundle& bundle() const { return bundle_; }
  const Processor& processor() const { return processor_; }
  const Device& device() const { return *device_; }
  Device& device() { return *device_; }
  const Solver& solver() const { return solver_; }
  const ParamList& params() const { return *params_; }
  /// What `act` does with a leftover: nothing where actions are relative to a state, which the rows would have lost.
  RealTimeChunking real_time_chunking() const;
  /// Rows of a chunk.
  int horizon() const { return processor_.n_row(horizon_); }
  /// Rows and columns of the solver's start: those of a chunk, or more.
  int solver_horizon() const { return horizon_; }
  int d_action_padded() const { return d_action_; }
  MemoryUse memory() const;
  /// Which kernel multiplies how many matrices, and how those are stored: `avx2 (98 bf16)`.
  const std::string& linear_kernels() const { return device_->linear_kernels(); }
  /// The kernels in use, as `--kernels` names them: those of the machine, or others where the bundle's dtype asks for
  /// float32.
  std::string kernels() const { return device_->kernels(); }
  /// Of the large products: "int8" where activations are int8, and weights ternary or quantized because somebody asked
  /// for it, "bf16" where activations are rounded to it (sums are float32), else "f32".
  Precision precision() const;
  bool has_int8_products() const { return precision() == Precision::int8; }
  /// The same as text for display.
  std::string arithmetic() const;
  /// Whether some weights are ternary.
  bool has_ternary() const;

 private:
  Engine(Bundle bundle, Processor processor) : bundle_(std::move(bundle)), processor_(std::move(processor)) {}
  static Result<std::vector<std::unique_ptr<Engine>>> open_robots(Bundle file, const EngineOptions& options);
  Status load_policy(std::shared_ptr<ParamList>& params);
  Status make_graphs();
  Status encode(const Observation& observation, const Noise& noise, const std::optional<Leftover>& leftover,
                Prepared& to) const;
  Status check_leftover(const Leftover& leftover, Inputs& inputs) const;
  Result<ActionChunk> run(Prepared& prepared);
  Status make_conditions();
  Status run_once(const Graph& graph);
  Status make_constants();
  Status make_plans();
  Status take_injected(const std::vector<Tap>& given);
  Status inject_inputs(Inputs& inputs) const;
  InputShape largest_shape() const;
  ChunkShape chunk_shape() const;
  std::uint32_t placed(std::uint32_t views) const;
  Result<std::vector<float>> start(const Noise& noise) const;
  template <class T>
  void record(std::vector<Tap>& taps, const char* path, std::vector<std::int64_t> shape,
              const std::vector<T>& values) const;
  void record_inputs(std::vector<Tap>& taps, const Inputs& inputs) const;
  std::vector<float> normalized(const std::vector<float>& x) const;
  void record_chunk(ActionChunk& chunk) const;

  Bundle bundle_;
  Processor processor_;
  std::vector<std::unique_ptr<Engine>> others_;  // of the first robot
  std::shared_ptr<Device> device_;
  Solver solver_;
  int horizon_ = 0, d_action_ = 0, d_state_ = 0;
  std::string tap_pattern_;
  std::vector<Tap> injected_;        // of the network
  std::vector<Tap> injected_input_;  // of what it reads
  bool dry_ = false;
  bool chose_kernels_ = false;         // somebody did
  std::shared_ptr<ParamList> params_;  // of all robots
  std::unique_ptr<Policy> policy_;
  std::unique_ptr<Slots> tables_;
  const Slot* conditions_ = nullptr;  // in tables_
  std::unique_ptr<Slots> constant_slots_;
  Cache constants_;       // in constant_slots_
  Plans::All all_plans_;  // of all robots
  std::unique_ptr<Plans> plans_;
  std::optional<InputShape> last_shape_;
  Prepared prepared_;  // of the last observation that came to `act` as a whole
};

}  // namespace vla
