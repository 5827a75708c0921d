// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/plan.h"

#include <fmt/format.h>

#include "nn/tokens.h"

namespace vla {
namespace {

/// Tensors of a plan's store: inputs, x, k, two for each cached layer, and a handful of constants for each graph.
std::size_t store_capacity(const Weights& weights) { return 64 + 2 * weights.count(); }

/// Memory that all plans together may take. A robot uses a few instructions of a few lengths; the limit is for the
/// others.
constexpr std::size_t kMaxPlanBytes = std::size_t{256} << 20;

TapFilter prefix_filter(const std::string& pattern) {
  if (pattern.empty()) return {};
  return [pattern](const std::string& path) { return match_path(pattern, path); };
}

/// The step graph is one for all steps: it keeps what any step wants, and `collect_step_taps` picks.
TapFilter step_filter(const std::string& pattern, int n_step) {
  if (pattern.empty()) return {};
  return [pattern, n_step](const std::string& path) {
    for (int k = 0; k < n_step; ++k)
      if (match_path(pattern, fmt::format("step.{}.{}", k, path))) return true;
    return false;
  };
}

Tap read_tap(std::string path, Tensor tensor) { return {std::move(path), tensor.shape(), Store::get(tensor)}; }

}  // namespace

Plan::Plan(const PlanContext& context, const InputShape& shape)
    : tap_pattern_(context.tap_pattern),
      store_(store_capacity(context.weights)),
      in_{store_.add_f32({shape.width, shape.height, 3, shape.n_view}), store_.add_i32({shape.n_text}),
          shape.d_state > 0 ? store_.add_f32({shape.d_state, 1}) : Tensor(), shape.views},
      x_(store_.add_f32({context.d_action, context.horizon})),
      k_(store_.add_i32({1})),
      cache_(context.constants),
      prefix_(context.weights, store_, prefix_filter(tap_pattern_)),
      step_(context.weights, store_, step_filter(tap_pattern_, context.solver.n_step)) {}

void Plan::build_prefix(const PlanContext& context) { context.policy.prefix(prefix_, in_, cache_); }

void Plan::build_step(const PlanContext& context) {
  Graph& g = step_;
  const Tensor condition = column(g, context.conditions, k_);
  const Tensor velocity = context.policy.velocity(g, x_, condition, cache_);
  g.write(g.name("x", add(g, x_, scale(g, velocity, context.solver.dt))), x_);
}

Result<std::unique_ptr<Plan>> Plan::build(const PlanContext& context, const InputShape& shape, ComputeMemory& memory) {
  VLA_CHECK(context.policy.check(shape));
  std::unique_ptr<Plan> plan(new Plan(context, shape));
  plan->build_prefix(context);
  plan->build_step(context);
  VLA_CHECK(plan->store_.allocate(context.device));
  VLA_CHECK(plan->prefix_.reserve(memory));
  VLA_CHECK(plan->step_.reserve(memory));
  VLA_CHECK(plan->prefix_.allocate(memory));
  VLA_CHECK(plan->step_.allocate(memory));
  return plan;
}

void Plan::set_inputs(std::span<const float> pixels, std::span<const std::int32_t> tokens,
                      std::span<const float> state) {
  Store::set(in_.images, pixels.data(), pixels.size_bytes());
  Store::set(in_.tokens, tokens.data(), tokens.size_bytes());
  if (in_.state) Store::set(in_.state, state.data(), state.size_bytes());
}

void Plan::set_x(std::span<const float> x) { Store::set(x_, x.data(), x.size_bytes()); }

std::vector<float> Plan::x() const { return Store::get(x_); }

Status Plan::run_step(const Device& device, int k) {
  const std::int32_t index = k;
  Store::set(k_, &index, sizeof(index));
  return step_.run(device);
}

StageWork Plan::work(int n_step) const {
  StageWork parts;
  for (const Stage& stage : prefix_.stages()) parts.emplace_back(stage.name, Work());
  parts.emplace_back("prefix", Work());
  const std::vector<Work> prefix = prefix_.work();
  for (std::size_t i = 0; i < prefix.size(); ++i) parts[i].second = prefix[i];
  const Work step = step_.work().front();
  parts.emplace_back("steps", Work{n_step * step.flop, n_step * step.bytes});
  return parts;
}

void Plan::collect_prefix_taps(std::vector<Tap>& taps) const {
  for (const auto& [path, tensor] : prefix_.taps()) taps.push_back(read_tap(path, tensor));
}

void Plan::collect_step_taps(int k, std::vector<Tap>& taps) const {
  for (const auto& [path, tensor] : step_.taps()) {
    const std::string full = fmt::format("step.{}.{}", k, path);
    if (match_path(tap_pattern_, full)) taps.push_back(read_tap(full, tensor));
  }
}

Result<Plan*> Plans::for_shape(const InputShape& shape) {
  if (const auto found = plans_.find(shape); found != plans_.end()) return found->second.get();
  if (size() > kMaxPlanBytes) plans_.clear();
  const std::size_t before = memory_.size();
  auto plan = Plan::build(context_, shape, memory_);
  if (memory_.size() != before) plans_.clear();  // their graphs point into memory that is gone
  if (!plan) return plan.error();
  return (plans_[shape] = std::move(*plan)).get();
}

void Plans::touch() const {
  for (const auto& [shape, plan] : plans_) plan->touch();
}

std::size_t Plans::size() const {
  std::size_t bytes = 0;
  for (const auto& [shape, plan] : plans_) bytes += plan->size();
  return bytes;
}

}  // namespace vla
