// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <functional>
#include <initializer_list>
#include <map>
#include <utility>
#include <vector>

#include "devices/devices.h"
#include "support/ggml_threads.h"

namespace vla::test {

/// One graph on a device of its own: recorded, lowered, and run as often as wanted.
class GraphRunner {
 public:
  /// Values of paths that `filter` wants are kept. An empty name takes the best kernels that the machine has.
  GraphRunner(const ParamList& params, const std::string& kernels, TapFilter filter = is_result, int n_thread = 2)
      : device_(open(n_thread, kernels)), graph(slots_, std::move(filter)) {
    const Status loaded = device_->load(params, true);
    REQUIRE_MESSAGE(loaded.ok(), (loaded.ok() ? "" : loaded.error().message()));
  }
  static bool is_result(const std::string& path) { return path == "result"; }

  /// A slot that holds these values when the program is lowered.
  Slot* slot(std::vector<float> values, const Shape& shape) {
    Slot* made = slots_.add_f32(shape);
    values_[made] = std::move(values);
    return made;
  }
  void set(const Slot* slot, const std::vector<float>& values) {
    REQUIRE(values.size() * sizeof(float) == slot->size());
    device_->set(*slot, values.data(), slot->size());
  }
  std::vector<float> get(const Slot* slot) const { return device_->get(*slot); }

  /// Lowers what was recorded, and computes what does not vary.
  Program& lower(const LowerOptions& options = {}) {
    const Status lowered = try_lower(options);
    REQUIRE_MESSAGE(lowered.ok(), (lowered.ok() ? "" : lowered.error().message()));
    REQUIRE(program_->prepare().ok());
    return *program_;
  }
  Status try_lower(const LowerOptions& options = {}) {
    REQUIRE(device_->allocate(slots_).ok());
    for (const auto& [slot, values] : values_) set(slot, values);
    VLA_TRY(program_, device_->lower(graph, options));
    return {};
  }
  void run() { REQUIRE(program_->run().ok()); }
  std::vector<float> tap(const std::string& path) const {
    for (std::size_t i = 0; i < program_->taps().size(); ++i)
      if (program_->taps()[i].path == path) return program_->tap(i);
    FAIL("no tap " << path);
    return {};
  }
  Device& device() { return *device_; }

 private:
  static std::unique_ptr<Device> open(int n_thread, const std::string& kernels) {
    auto device = open_device(threads_for(kernels, n_thread), kernels);
    REQUIRE_MESSAGE(device.ok(), (device ? "" : device.error().message()));
    return std::move(*device);
  }

  std::unique_ptr<Device> device_;
  Slots slots_;
  std::map<const Slot*, std::vector<float>> values_;
  std::unique_ptr<Program> program_;

 public:
  Graph graph;
};

/// Builds a graph on these parameters, runs it, and returns the values of what `build` returns.
inline std::vector<float> run_graph(const ParamList& params, const std::function<Tensor(Graph&)>& build,
                                    const std::string& kernels = "") {
  GraphRunner runner(params, kernels);
  runner.graph.name("result", build(runner.graph));
  runner.lower();
  runner.run();
  return runner.tap("result");
}

/// The same without parameters.
inline std::vector<float> run_graph(const std::function<Tensor(Graph&)>& build, const std::string& kernels = "") {
  return run_graph(ParamList(Keys(), nullptr), build, kernels);
}

/// Sizes with ones behind them.
inline Shape shape_of(std::initializer_list<std::int64_t> sizes) {
  Shape shape = {1, 1, 1, 1};
  std::copy(sizes.begin(), sizes.end(), shape.begin());
  return shape;
}

/// Values as a tensor.
inline Tensor constant(Graph& g, std::vector<float> values, std::initializer_list<std::int64_t> sizes) {
  return g.constant(std::move(values), shape_of(sizes));
}

/// Deterministic values in [-range, range].
inline std::vector<float> ramp(std::size_t count, float range) {
  std::vector<float> values(count);
  std::uint32_t state = 12345;
  for (float& value : values) {
    state = state * 1664525u + 1013904223u;
    value = range * (static_cast<float>(state >> 8) / 8388608.0f - 1.0f);
  }
  return values;
}

}  // namespace vla::test
