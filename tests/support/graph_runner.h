// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <functional>
#include <vector>

#include "backend/graph.h"

namespace vla::test {

/// Builds a graph on these parameters, runs it, and returns the values of what `build` returns. An empty name takes the
/// best kernels that the machine has.
inline std::vector<float> run_graph(const ParamList& params, const std::function<Tensor(Graph&)>& build,
                                    const std::string& kernels = "") {
  const auto device = Device::cpu(2, kernels);
  REQUIRE(device.ok());
  const auto weights = Weights::load(params, *device, Weights::Fill::yes);
  REQUIRE(weights.ok());
  Store store(256);
  Graph graph(*weights, store, [](const std::string& path) { return path == "result"; });
  graph.name("result", build(graph));
  ComputeMemory memory(*device);
  REQUIRE(store.allocate(*device).ok());
  REQUIRE(graph.reserve(memory).ok());
  REQUIRE(graph.allocate(memory).ok());
  REQUIRE(graph.run(*device).ok());
  return Store::get(graph.taps().front().second);
}

/// The same without parameters.
inline std::vector<float> run_graph(const std::function<Tensor(Graph&)>& build, const std::string& kernels = "") {
  return run_graph(ParamList(Keys(), nullptr), build, kernels);
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
