// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/plan.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "nn/tokens.h"

namespace vla {
namespace {

/// The memory limit of all plans of an engine. A robot sends instructions of a few lengths; the limit protects against
/// clients that send many.
constexpr std::size_t kMaxPlanBytes = std::size_t{256} << 20;

TapFilter prefix_filter(const std::string& pattern) {
  if (pattern.empty()) return {};
  return [pattern](const std::string& path) { return match_path(pattern, path); };
}

/// All steps share one graph, so it keeps every tap that the pattern selects in any step; `collect_step_taps` selects.
TapFilter step_filter(const std::string& pattern, int n_step) {
  if (pattern.empty()) return {};
  return [pattern, n_step](const std::string& path) {
    for (int k = 0; k < n_step; ++k)
      if (match_path(pattern, fmt::format("step.{}.{}", k, path))) return true;
    return false;
  };
}

}  // namespace

Plan::Plan(const Network& network, const InputShape& shape, const PlanContext& context)
    : tap_pattern_(context.tap_pattern),
      device_(context.device),
      images_(shape.n_view > 0 ? slots_.add_f32({shape.width, shape.height, 3, shape.n_view}) : nullptr),
      tokens_(shape.n_text > 0 ? slots_.add_i32({shape.n_text, 1, 1, 1}) : nullptr),
      state_(shape.d_state > 0 ? slots_.add_f32({shape.d_state, 1, 1, 1}) : nullptr),
      x_(network.solver.decodes ? nullptr : slots_.add_f32({network.d_action, network.horizon, 1, 1})),
      token_(network.solver.decodes ? slots_.add_i32({1, 1, 1, 1}) : nullptr),
      k_(slots_.add_i32({1, 1, 1, 1})),
      noise_(network.solver.rereads_noise() ? slots_.add_f32({count(x_->shape), network.solver.n_noise(), 1, 1})
                                            : nullptr),
      target_(shape.steered ? slots_.add_f32(x_->shape) : nullptr),
      keep_(shape.steered ? slots_.add_f32({network.horizon, network.solver.n_step, 1, 1}) : nullptr),
      pull_(shape.steered ? slots_.add_f32({network.horizon, network.solver.n_step, 1, 1}) : nullptr),
      solver_(network.solver),
      views_(shape.views),
      text_(shape.text),
      cache_(network.constants),
      injection_(context.injected, slots_) {}

/// v' = keep * v + pull * (x - target), row by row.
Tensor Plan::steered(Graph& g, Tensor x, Tensor k, Tensor velocity) const {
  const auto of_rows = [&](const Slot* table) {
    return g.add(op::Reshape{}, {column(g, g.input(table), k)}, {1, table->shape[0], 1, 1});
  };
  const Tensor off = add(g, x, scale(g, g.input(target_), -1));
  return add(g, multiply(g, velocity, of_rows(keep_)), multiply(g, off, of_rows(pull_)));
}

TapVisitor Plan::visitor_of_steps(const TapVisitor& see) const {
  if (!see) return {};
  return [this, see](const std::string& path, auto shape, auto values) {
    const std::string of_step = fmt::format("step.{}.{}", i_step_, path);
    if (match_path(tap_pattern_, of_step)) see(of_step, shape, values);
  };
}

Status Plan::lower(const Network& network, const PlanContext& context) {
  Graph prefix(slots_, prefix_filter(tap_pattern_), injection_.of_prefix());
  Graph step(slots_, step_filter(tap_pattern_, network.solver.n_step), injection_.of_step(network.solver.n_run()));
  const auto input = [&](const Slot* slot) { return slot != nullptr ? prefix.input(slot) : Tensor(); };
  network.policy.prefix(prefix, {input(images_), input(tokens_), input(state_), views_, text_}, cache_);
  LowerOptions changing = {{k_}, visitor_of_steps(context.see_tap)};
  if (token_ != nullptr)
    record_decoder(step, network, changing);
  else
    record_solver(step, network, changing);
  // The step advances k on the device, so nothing is uploaded between steps.
  if (network.conditions != nullptr || target_ != nullptr || solver_.counts())
    step.write(solver_.after(step, step.input(k_)), k_);

  if (context.see_graph)
    for (const Graph* graph : {&prefix, &step}) context.see_graph(*graph);
  VLA_CHECK(injection_.check());
  VLA_CHECK(device_.allocate(slots_));
  LowerOptions varying = {{}, context.see_tap};
  for (const Slot* slot : {images_, tokens_, state_})
    if (slot != nullptr) varying.varying.push_back(slot);
  for (const Slot* slot : injection_.slots()) varying.varying.push_back(slot), changing.varying.push_back(slot);
  VLA_TRY(prefix_, device_.lower(prefix, varying));
  VLA_TRY(step_, device_.lower(step, changing));
  return context.dry ? Status() : prefix_->prepare();
}

void Plan::record_solver(Graph& step, const Network& network, LowerOptions& changing) const {
  const Tensor x = step.input(x_), k = step.input(k_);
  const Tensor condition = network.conditions != nullptr ? column(step, step.input(network.conditions), k) : Tensor();
  Tensor answer = network.policy.velocity(step, x, condition, cache_);
  changing.varying.push_back(x_);
  if (target_ != nullptr) {
    answer = steered(step, x, k, answer);
    changing.varying.insert(changing.varying.end(), {target_, keep_, pull_});
  }
  const Tensor noise = noise_ != nullptr ? step.input(noise_) : Tensor();
  step.write(step.name("x", solver_.next(step, x, answer, noise, k)), x_);
}

/// Prefix and step write their logits to the same slot. The step appends its keys and values to slots that its next
/// runs read.
void Plan::record_decoder(Graph& step, const Network& network, LowerOptions& changing) {
  logits_ = cache_.slot("logits");
  read_logits_.resize(static_cast<std::size_t>(count(logits_->shape)));
  decoded_.reserve(static_cast<std::size_t>(solver_.n_step));
  const Tensor logits =
      network.policy.decode(step, step.input(token_), step.input(k_), std::max(1, solver_.n_run()), cache_);
  step.write(step.name("logits", logits), logits_);
  for (const Slot* slot : cache_.appended())
    no_token_.resize(std::max(no_token_.size(), static_cast<std::size_t>(count(slot->shape))));
  changing.varying.push_back(token_);
  changing.varying.insert(changing.varying.end(), cache_.appended().begin(), cache_.appended().end());
}

Result<std::unique_ptr<Plan>> Plan::build(const Network& network, const InputShape& shape, const PlanContext& context) {
  VLA_CHECK(network.policy.check(shape));
  std::unique_ptr<Plan> plan(new Plan(network, shape, context));
  VLA_CHECK(plan->lower(network, context));
  return plan;
}

void Plan::set_inputs(std::span<const float> pixels, const Device::Sent* ahead, std::span<const std::int32_t> tokens,
                      std::span<const float> state) {
  if (ahead != nullptr)
    device_.take(*images_, *ahead);
  else if (images_ != nullptr)
    device_.set(*images_, pixels.data(), pixels.size_bytes());
  if (tokens_ != nullptr) device_.set(*tokens_, tokens.data(), tokens.size_bytes());
  if (state_ != nullptr) device_.set(*state_, state.data(), state.size_bytes());
}

void Plan::set_noise(std::span<const float> noise) {
  constexpr std::int32_t kFirst = 0;
  if (x_ != nullptr) device_.set(*x_, noise.data(), x_->size());
  device_.set(*k_, &kFirst, sizeof(kFirst));
  if (noise_ != nullptr) device_.set(*noise_, noise.data(), noise.size_bytes());
  decoded_.clear();
  for (const Slot* slot : cache_.appended()) device_.set(*slot, no_token_.data(), slot->size());
}

void Plan::set_steering(const Steering& steering) {
  device_.set(*target_, steering.target.data(), steering.target.size() * sizeof(float));
  device_.set(*keep_, steering.keep.data(), steering.keep.size() * sizeof(float));
  device_.set(*pull_, steering.pull.data(), steering.pull.size() * sizeof(float));
}

Status Plan::run_prefix(std::vector<Tap>& taps) {
  injection_.set(device_, 0);
  VLA_CHECK(prefix_->run());
  for (std::size_t i = 0; i < prefix_->taps().size(); ++i)
    taps.push_back({prefix_->taps()[i].path, dims(prefix_->taps()[i].shape), prefix_->tap(i)});
  VLA_CHECK(step_->prepare());  // after the taps are read: it reuses the prefix's working memory
  prefix_ended_ = std::chrono::steady_clock::now();
  return {};
}

Result<bool> Plan::needs_step(int k) {
  if (token_ == nullptr) return k < solver_.n_step;
  device_.get(*logits_, read_logits_.data(), logits_->size());
  VLA_CHECK(device_.failure());
  if (!std::ranges::all_of(read_logits_, [](float x) { return std::isfinite(x); }))
    return Error{Code::bad_action, fmt::format("token {}", k), "finite logits", "one that is not"};
  const auto likeliest = static_cast<std::int32_t>(std::ranges::max_element(read_logits_) - read_logits_.begin());
  decoded_.push_back(static_cast<float>(likeliest));
  device_.set(*token_, &likeliest, sizeof(likeliest));
  return likeliest != solver_.stop_token && k < solver_.n_run();
}

Status Plan::run_step(int k) {
  i_step_ = k;
  if (k > 0) injection_.set(device_, k);
  return step_->run();
}

StageWork Plan::work(int n_step) const {
  StageWork parts;
  for (const Program::Stage& stage : prefix_->stages()) parts.emplace_back(stage.name, Work());
  parts.emplace_back("prefix", Work());
  const std::vector<Work> prefix = prefix_->work();
  for (std::size_t i = 0; i < prefix.size(); ++i) parts[i].second = prefix[i];
  parts.emplace_back("steps", step_->work().front().times(n_step));
  return parts;
}

StagePredictions Plan::predict(int n_step) const {
  const std::vector<Program::Prediction> prefix = prefix_->predictions(), step = step_->predictions();
  if (prefix.empty() || step.empty()) return {};
  StagePredictions parts;
  for (std::size_t i = 0; i + 2 < prefix.size(); ++i) parts.emplace_back(prefix_->stages()[i].name, prefix[i]);
  parts.emplace_back("prefix", prefix[prefix.size() - 2]);
  Program::Prediction steps;
  for (int k = 0; k < n_step; ++k) steps += step.front();
  (device_.is_host() ? parts.back().second : steps) += step.back();  // `prepare`; on the host before `prefix_ended`
  parts.emplace_back("steps", steps);
  return parts;
}

void Plan::collect_step_taps(int k, std::vector<Tap>& taps) const {
  for (std::size_t i = 0; i < step_->taps().size(); ++i) {
    const std::string path = fmt::format("step.{}.{}", k, step_->taps()[i].path);
    if (match_path(tap_pattern_, path)) taps.push_back({path, dims(step_->taps()[i].shape), step_->tap(i)});
  }
}

const Plan* Plans::find(const Network& network, const InputShape& shape) const {
  const auto found = plans_.find({&network.policy, shape});
  return found != plans_.end() ? found->second.get() : nullptr;
}

Result<Plan*> Plans::for_shape(const Network& network, const InputShape& shape) {
  const std::pair key(&network.policy, shape);
  if (const auto found = plans_.find(key); found != plans_.end()) return found->second.get();
  if (size() > kMaxPlanBytes) clear();
  VLA_TRY(std::unique_ptr<Plan> plan, Plan::build(network, shape, context_));
  return (plans_[key] = std::move(plan)).get();
}

std::size_t Plans::size() const {
  std::size_t bytes = 0;
  for (const auto& [key, plan] : plans_) bytes += plan->size();
  return bytes;
}

}  // namespace vla
