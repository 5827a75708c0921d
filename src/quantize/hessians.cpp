// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/hessians.h"

#include <fmt/format.h>

#include <algorithm>

#include "quantize/graphs.h"

namespace vla {
namespace {

/// Most bytes of Hessians that are measured at a time.
std::size_t most_bytes(std::size_t budget) {
  constexpr std::size_t kMost = std::size_t{1} << 30;
  return budget > 0 ? std::min(kMost, budget / 4) : kMost;
}

}  // namespace

Result<Hessians> Hessians::of(const std::string& bundle, std::span<const Judged> observations, EngineOptions options) {
  options.kernels = "float32";
  Hessians hessians(bundle, observations, options);
  MatrixInputs inputs;
  VLA_TRY(const std::unique_ptr<Engine> engine,
          see_graphs(bundle, options, [&](const Graph& graph) { add_inputs(graph, inputs); }));
  for (auto& [bytes, paths] : inputs)
    if (!paths.contains("")) hessians.inputs_.emplace(engine->robot().bundle().offset(bytes), std::move(paths));
  return hessians;
}

/// The paths of the values that a matrix multiplies; null if not all of them have one.
const std::set<std::string>* Hessians::inputs_of(const Bundle& bundle, const TensorInfo& tensor) const {
  const auto found = inputs_.find(bundle.offset(tensor.data.data()));
  return found != inputs_.end() ? &found->second : nullptr;
}

Result<std::span<const float>> Hessians::feedback(const Bundle& bundle, const TensorInfo& tensor) {
  ++n_asked_;
  const std::set<std::string>* const paths = inputs_of(bundle, tensor);
  if (paths == nullptr) return std::span<const float>();
  ++n_known_;
  if (!feedback_.contains(*paths)) VLA_CHECK(measure(bundle, tensor));
  return std::span<const float>(feedback_.at(*paths));
}

/// Measures the Hessians for this tensor and for as many after it as fit in memory.
Status Hessians::measure(const Bundle& bundle, const TensorInfo& first) {
  feedback_.clear();
  std::map<std::set<std::string>, Hessian> sums;
  std::multimap<std::string, Hessian*> readers;  // Hessians by their value's path
  std::size_t size = 0;
  for (const TensorInfo& tensor : std::span(bundle.tensors()).subspan(&first - bundle.tensors().data())) {
    const std::set<std::string>* const paths = inputs_of(bundle, tensor);
    if (paths == nullptr || sums.contains(*paths)) continue;
    size += Hessian::size(tensor.shape[0]);
    if (!sums.empty() && size > most_bytes(options_.memory)) break;
    Hessian& made = sums.try_emplace(*paths, tensor.shape[0]).first->second;
    for (const std::string& path : *paths) readers.emplace(path, &made);
  }
  EngineOptions options = options_;
  for (const auto& [path, hessian] : readers) options.tap_pattern += fmt::format("{0},step.*.{0},", path);
  options.tap_pattern.pop_back();
  options.see_tap = [&](const std::string& path, auto, auto values) {
    const auto [begin, end] = readers.equal_range(without_step(path));
    for (auto one = begin; one != end; ++one) one->second->add(values);
  };
  VLA_TRY(const Chunks chunks, chunks_of(bundle_, options, observations_));
  for (auto& [paths, hessian] : sums) feedback_.emplace(paths, std::move(hessian).feedback());
  return {};
}

}  // namespace vla
