// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "devices/devices.h"
#include "engine/robot.h"
#include "graph/rounding.h"

namespace vla {

struct EngineOptions {
  int n_thread = 0;         // 0: every core that the process may use
  std::string kernels;      // as open_device takes them; empty: the best that the machine has for the bundle's dtype
  std::string model;        // of a device that is not there, as open_model takes it; only where `dry`
  std::string device;       // cpu, vulkan:N or cuda:N, as open_device takes them; empty: the CPU
  std::string tap_pattern;  // empty: nothing is recorded, and the graphs are the production graphs
  /// Values at taps that take the place of the computed ones: as the network's own, or as `pixels` and `state`.
  std::vector<Tap> inject = {};
  bool dry = false;             // reserve memory without filling it: sizes are exact, and `act` must not be called
  std::string embodiment = {};  // the robot, by its tag; empty where the bundle is for one
  bool all_robots = false;      // without a tag: every robot of a bundle of several
  std::function<void(const Graph&)> see_graph = {};  // is shown the graphs of every plan, before they are lowered
  /// Is shown values at taps, most of them as soon as they are computed, in the place of ActionChunk::taps, which keeps
  /// all of them.
  TapVisitor see_tap = {};
  std::size_t memory = 0;  // bytes that the process, or on a GPU the policy there, may take; 0: no limit
};

/// Memory by what it holds, in bytes: parameters and tables; inputs and cache of the plans; what graphs share while
/// they run.
struct MemoryUse {
  std::size_t weights = 0, plan = 0, working = 0;
  std::size_t total() const { return weights + plan + working; }
};

/// How EngineOptions::memory is kept, in bytes.
struct MemoryBudget {
  std::size_t size = 0;
  std::size_t process = 0;   // what the process took without the engine's memory; 0 on a GPU
  std::size_t smallest = 0;  // the least budget that would do
  std::size_t n_read = 0;    // of the file, in every act; 0: all matrices stay in memory
};

/// A loaded bundle, ready to act: the device with the parameters, the bundle's robots, and their plans. It owns the
/// loop that every architecture runs: prefix, cache, solver steps, unnormalize. One thread at a time may call it, and
/// others its const functions meanwhile.
class Engine {
 public:
  /// Opens, checks and loads a bundle, and builds the largest plans. Errors: io, bad_bundle, unsupported,
  /// out_of_memory (also where the budget is too small, with the least that would do), device.
  static Result<std::unique_ptr<Engine>> load(const std::string& path, const EngineOptions& options);

  /// In the bundle's order; at least one.
  std::vector<const Robot*> robots() const;
  /// The first one, which is the only one without EngineOptions::all_robots.
  const Robot& robot() const { return *robots_.front(); }
  /// The robot that answers to this tag; an empty one where there is one robot. Errors: bad_observation, with the tags
  /// that there are.
  Result<const Robot*> robot(const std::string& tag) const;

  /// Computes the chunk of the robot that the observation names. `leftover`: rows of the previous chunk that are not
  /// executed yet, which the new chunk continues. Errors: bad_observation, bad_action (a number that is not finite came
  /// out), unsupported, device, out_of_memory.
  Result<ActionChunk> act(const Observation& observation, const Noise& noise,
                          const std::optional<Leftover>& leftover = {}) noexcept;
  /// The halves of an act. The host's: any thread may encode while another one computes. Errors: bad_observation,
  /// unsupported, out_of_memory.
  Status encode(const Observation& observation, const Noise& noise, const std::optional<Leftover>& leftover,
                EncodedObservation& to) const noexcept;
  /// The device's, with unnormalization. Errors: those of `act`.
  Result<ActionChunk> compute(EncodedObservation& encoded) noexcept;
  /// Between them: the images go to the device while it computes another act. Errors: out_of_memory.
  Status send_ahead(EncodedObservation& encoded) const noexcept;

  /// Of the last act: whose, and of which size. None before the first.
  std::optional<ActShape> last_shape() const;
  /// Computes an act of zeros, so that the first one of this size finds its plan, and on a GPU its graph. Errors:
  /// bad_observation (no observation of this bundle has that size), device, out_of_memory, internal.
  Status warm_up(const ActShape& act) noexcept;
  /// Computes an act again with all taps: the path of the first value of the network that is not finite, or nothing
  /// where all are. Slow, since its plans are built for it; no other thread may prepare meanwhile. Errors: those of
  /// `act` but bad_action.
  Result<std::string> find_not_finite(const Observation& observation, const Noise& noise);
  /// Solves for the first robot in another number of steps than the bundle asks for, to measure what a step costs; no
  /// other thread may prepare meanwhile. Errors: bad_bundle, out_of_memory, device.
  Status set_steps(int n_step);
  /// The program of the prefix or of a step for the first robot's largest observation, one line an operation: phase,
  /// kernel, MFLOP, MB, what is computed, and how its operand and results lie in memory. Errors: out_of_memory.
  enum class Part { prefix, step };
  Result<std::string> program_text(Part part);
  /// The work of the network for the last observation; empty before the first, and where its plan is gone.
  StageWork work() const;

  /// How long the first robot's largest observation takes, of a dry engine: by a model of the device, or on the CPU by
  /// one phase of each kind, which is run (Program::predictions). Else empty. Errors: out_of_memory.
  Result<StagePredictions> predict();

  const Device& device() const { return *device_; }
  Device& device() { return *device_; }
  /// The parameters of all robots.
  const ParamList& params() const { return robot().params(); }
  MemoryUse memory() const;
  /// All zeros without a budget.
  const MemoryBudget& budget() const { return budget_; }
  /// Which kernel multiplies how many matrices, and how those are stored: `avx2 (98 bf16)`.
  const std::string& linear_kernels() const { return device_->linear_kernels(); }
  /// The kernels in use, as `--kernels` names them: those of the machine, or others where the bundle's dtype asks for
  /// float32.
  std::string kernels() const { return device_->kernels(); }
  /// The precision of the large products: "int8" where activations are int8, and weights ternary or quantized on
  /// request, "bf16" where activations are rounded to it (sums are float32), else "f32".
  Precision precision() const;
  bool has_int8_products() const { return precision() == Precision::int8; }
  /// The same as text for display.
  std::string arithmetic() const;
  /// Whether some weights are ternary.
  bool has_ternary() const;

 private:
  explicit Engine(const EngineOptions& options)
      : tap_pattern_(options.tap_pattern),
        see_graph_(options.see_graph),
        see_tap_(options.see_tap),
        dry_(options.dry),
        chose_kernels_(!options.kernels.empty()) {}
  Status open_robots(Bundle file, const EngineOptions& options);
  Status take_injected(const std::vector<Tap>& given);
  Status build(const WeightPlan& plan, bool dry);
  Result<WeightPlan> plan_weights(std::size_t budget);
  Status make_plans(bool dry);
  Status inject_inputs(Inputs& inputs) const;
  Result<ActionChunk> run(EncodedObservation& encoded);
  Status solve(Plan& plan, int n_step, std::vector<Tap>& taps);
  void show(std::vector<Tap>& taps) const;
  template <class T>
  void record(std::vector<Tap>& taps, const char* path, std::vector<std::int64_t> shape,
              const std::vector<T>& values) const;

  std::string tap_pattern_;
  std::function<void(const Graph&)> see_graph_;
  TapVisitor see_tap_;
  bool dry_, chose_kernels_;         // somebody chose them
  std::vector<Tap> injected_;        // of the network
  std::vector<Tap> injected_input_;  // of what it reads
  std::unique_ptr<Device> device_;   // goes after what it made
  std::vector<std::unique_ptr<Robot>> robots_;
  std::optional<Plans> plans_;
  std::optional<std::pair<const Robot*, InputShape>> last_;
  MemoryBudget budget_;
  EncodedObservation encoded_;  // of the last observation that came to `act` as a whole
};

}  // namespace vla
