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
#include "devices/host_threads.h"
#include "engine/robot.h"
#include "graph/rounding.h"

namespace vla {

struct EngineOptions {
  int n_thread = 0;         // 0: every core that the process may use
  std::string kernels;      // kernel names for open_device; empty: the machine's best for the bundle's dtype
  std::string model;        // name of a device model for open_model; only with `dry`
  std::string device;       // cpu, vulkan:N or cuda:N; empty: the CPU
  std::string tap_pattern;  // empty: nothing is recorded
  /// Values that replace the computed ones at taps: those of the network, or `pixels` and `state`.
  std::vector<Tap> inject = {};
  bool dry = false;  // reserve memory without filling it: sizes are exact, and `act` must not be called
  std::vector<std::string> absent = {};  // views that no observation will have
  std::string embodiment = {};           // the robot's tag; empty if the bundle is for one robot
  bool all_robots = false;               // loads every robot of the bundle; then `embodiment` is empty
  /// Called with every graph before it is lowered: the graphs that run at load, and those of every plan.
  std::function<void(const Graph&)> see_graph = {};
  /// Receives the values of taps, most of them as soon as they are computed; on the CPU also the taps of the graphs
  /// that run at load. ActionChunk::taps stays empty.
  TapVisitor see_tap = {};
  std::size_t memory = 0;  // budget in bytes for the process, or for the policy on a GPU; 0: no limit
};

/// Memory by use, in bytes: parameters and tables; inputs and cache of plans; working memory that running graphs share.
struct MemoryUse {
  std::size_t weights = 0, plan = 0, working = 0;
  std::size_t total() const { return weights + plan + working; }
};

/// How the budget EngineOptions::memory is used, in bytes.
struct MemoryBudget {
  std::size_t size = 0;
  std::size_t process = 0;   // the process without the engine's memory; 0 on a GPU
  std::size_t smallest = 0;  // the least budget that works, with a margin because processes differ in size
  std::size_t n_read = 0;    // read from the file in every act; 0: all matrices stay in memory
};

/// A loaded bundle, ready to act: the device with the parameters, the bundle's robots, and their plans. It owns the
/// loop of every architecture: prefix, cache, solver steps, unnormalize. One thread at a time may call its non-const
/// functions; others may call const functions meanwhile.
class Engine {
 public:
  /// Opens, checks and loads a bundle, and builds the largest plans. Errors: io, bad_bundle, unsupported, device,
  /// out_of_memory (also if the budget is too small; the error states the least budget that works).
  static Result<std::unique_ptr<Engine>> load(const std::string& path, const EngineOptions& options);

  /// In the bundle's order; at least one.
  std::vector<const Robot*> robots() const;
  /// The first robot, and the only one without EngineOptions::all_robots.
  const Robot& robot() const { return *robots_.front(); }
  /// The robot with this tag. A single robot also has the empty tag. Errors: bad_observation, with the list of tags.
  Result<const Robot*> robot(const std::string& tag) const;

  /// Computes a chunk for the robot that the observation names. `leftover`: rows of the previous chunk that are not
  /// executed yet, which the new chunk continues. Errors: bad_observation, bad_action (a value is not finite),
  /// unsupported, device, out_of_memory.
  Result<ActionChunk> act(const Observation& observation, const Noise& noise,
                          const std::optional<Leftover>& leftover = {}) noexcept;
  /// The host's half of an act; `compute` is the other half. Any thread may encode while another one computes. Errors:
  /// bad_observation, unsupported, out_of_memory.
  Status encode(const Observation& observation, const Noise& noise, const std::optional<Leftover>& leftover,
                EncodedObservation& to) const noexcept;
  /// The device's half of an act, followed by unnormalization. Errors: those of `act`; late
  /// (EncodedObservation::is_late).
  Result<ActionChunk> compute(EncodedObservation& encoded) noexcept;
  /// Optional, between `encode` and `compute`: sends the images to the device while it computes another act. Errors:
  /// out_of_memory.
  Status send_ahead(EncodedObservation& encoded) const noexcept;

  /// The robot and the input size of the last act. None before the first act.
  std::optional<ActShape> last_shape() const;
  /// Computes an act with zeros as inputs, so that the plan of this size, and on a GPU its graph, are built before the
  /// first request. Errors: bad_observation (no observation of this bundle has that size), device, out_of_memory,
  /// internal.
  Status warm_up(const ActShape& act) noexcept;
  /// Computes an act again with all taps and returns the path of the network's first value that is not finite; empty if
  /// all are finite. Slow, because it builds plans for this call. No other thread may encode meanwhile. Errors: those
  /// of `act` except bad_action.
  Result<std::string> find_not_finite(const Observation& observation, const Noise& noise);
  /// Replaces the bundle's number of solver steps for the first robot, to measure the cost of a step. No other thread
  /// may encode meanwhile. Errors: bad_bundle, out_of_memory, device.
  Status set_steps(int n_step);
  /// The text of the prefix's or a step's program for the first robot's largest observation, one line per operation:
  /// phase, kernel, MFLOP, MB, the operation, and the layouts of operands and results. Errors: out_of_memory.
  enum class Part { prefix, step };
  Result<std::string> program_text(Part part);
  /// The network's work for the last observation. Empty before the first observation, or if its plan is evicted.
  StageWork work() const;

  /// Predicts the time of the first robot's largest observation for a dry engine: by a model of the device, or on the
  /// CPU by running one phase of each kind (Program::predictions). Empty otherwise. Errors: out_of_memory.
  Result<StagePredictions> predict();

  const Device& device() const { return *device_; }
  Device& device() { return *device_; }
  /// The parameters of all robots.
  const ParamList& params() const { return robot().params(); }
  MemoryUse memory() const;
  /// All zeros without a budget.
  const MemoryBudget& budget() const { return budget_; }
  /// The kernels of the matrix products, with the number of matrices per encoding: `avx2 (98 bf16)`.
  const std::string& linear_kernels() const { return device_->linear_kernels(); }
  /// The kernels in use, as `--kernels` names them: the machine's best, or others if the bundle's dtype asks for
  /// float32.
  std::string kernels() const { return device_->kernels(); }
  /// The precision of the large products: "int8" if activations are int8 and weights ternary or quantized on request,
  /// "bf16" if activations are rounded to bf16 (sums are float32), else "f32".
  Precision precision() const;
  bool has_int8_products() const { return precision() == Precision::int8; }
  /// The precision as a text for display.
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
  Status declare_absent(const std::string& view);
  Status open_robots(Bundle file, const EngineOptions& options);
  Status take_injected(const std::vector<Tap>& given);
  Status build(const WeightPlan& plan, bool dry);
  Result<WeightPlan> plan_weights(std::size_t budget);
  Status make_plans(bool dry);
  Status inject_inputs(Inputs& inputs) const;
  Result<ActionChunk> run(EncodedObservation& encoded);
  Status solve(Plan& plan, int most, const std::function<bool()>& is_late, std::vector<Tap>& taps);
  void show(std::vector<Tap>& taps) const;
  template <class Values>
  void record(std::vector<Tap>& taps, const char* path, std::vector<std::int64_t> shape, const Values& values) const;

  std::string tap_pattern_;
  std::function<void(const Graph&)> see_graph_;
  TapVisitor see_tap_;
  bool dry_, chose_kernels_;         // chose_kernels_: the user named the kernels
  std::vector<Tap> injected_;        // values to inject into the network
  std::vector<Tap> injected_input_;  // values to inject into the inputs: pixels, state
  std::unique_ptr<Device> device_;   // outlives the members below, which use it
  HostThreads host_threads_;         // empty if the device is the CPU
  std::vector<std::unique_ptr<Robot>> robots_;
  std::optional<Plans> plans_;
  std::optional<std::pair<const Robot*, InputShape>> last_;
  MemoryBudget budget_;
  EncodedObservation encoded_;  // buffer of `act`, reused by every call
};

}  // namespace vla
