// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/engine.h"

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <malloc.h>

#include <algorithm>
#include <cmath>
#include <new>
#include <utility>

#include "base/process.h"

namespace vla {
namespace {

/// Margin for the memory by which two processes with the same work differ: file pages that the system reads ahead.
/// Measured: 0.9 MB.
constexpr std::size_t kProcessesDiffer = std::size_t{3} << 20;

/// The error for std::bad_alloc of containers: the act fails, and the next one starts from scratch. The strings fit
/// into small-string buffers, so they allocate nothing.
Error no_memory() { return {Code::out_of_memory, "act", "", "no memory left", "free memory"}; }

/// Sets the plan's inputs: observation, noise and steering.
void set_inputs(Plan& plan, const EncodedObservation& observation) {
  const Inputs& in = observation.inputs;
  const std::optional<Steering>& steering = observation.steering;
  plan.set_inputs(in.pixels, observation.pixels_ahead.get(), in.tokens, in.state);
  plan.set_noise(steering ? steering->start : observation.noise);
  if (steering) plan.set_steering(*steering);
}

}  // namespace

Result<std::unique_ptr<Engine>> Engine::load(const std::string& path, const EngineOptions& options) {
  VLA_TRY(Bundle file, Bundle::open(path));
  std::unique_ptr<Engine> engine(new Engine(options));
  VLA_CHECK(engine->take_injected(options.inject));
  VLA_CHECK(engine->open_robots(std::move(file), options));
  malloc_trim(0);  // returns the hundreds of MB that reading a large vocabulary takes
  VLA_TRY(engine->device_, options.model.empty() ? open_device(options.n_thread, options.kernels, options.device)
                                                 : open_model(options.model, options.kernels, options.device));
  if (!options.dry && !engine->device_->is_host()) {  // on the CPU, more threads would delay the device's own
    VLA_TRY(engine->host_threads_, HostThreads::start(options.n_thread));
  }
  WeightPlan plan;
  if (options.memory > 0) {
    VLA_TRY(plan, engine->plan_weights(options.memory));
  }
  VLA_CHECK(engine->build(plan, options.dry));
  if (!options.dry) engine->device_->touch();
  return engine;
}

/// Declares the view absent for every robot that has it.
Status Engine::declare_absent(const std::string& view) {
  bool is_known = false;
  for (const auto& robot : robots_) {
    if (!robot->processor().views().find(view)) continue;
    is_known = true;
    VLA_CHECK(robot->declare_absent(view));
  }
  return is_known ? Status() : robots_.front()->declare_absent(view);
}

/// Opens each robot with the bundle reduced to that robot.
Status Engine::open_robots(Bundle file, const EngineOptions& options) {
  std::vector<std::string> tags = {options.embodiment};
  if (options.all_robots && options.embodiment.empty() && !file.embodiments().empty()) tags = file.embodiments();
  for (const std::string& tag : tags) {
    Bundle bundle = robots_.size() + 1 < tags.size() ? file : std::move(file);
    VLA_CHECK(bundle.choose(tag));
    VLA_TRY(std::unique_ptr<Robot> robot, Robot::open(std::move(bundle), robots_.empty() ? nullptr : &this->robot()));
    if (!robots_.empty()) robot->forget_tokenizer();
    robots_.push_back(std::move(robot));
  }
  robots_.front()->forget_tokenizer();  // the other robots were compared with it
  for (const std::string& view : options.absent) VLA_CHECK(declare_absent(view));
  return {};
}

/// Loads the parameters, computes the robots' constants and builds the plans.
Status Engine::build(const WeightPlan& plan, bool dry) {
  VLA_CHECK(device_->load(params(), !dry, plan));
  const PlanContext context = {*device_, tap_pattern_, dry, nullptr, see_graph_, see_tap_};
  for (const auto& robot : robots_) VLA_CHECK(robot->compute_constants(context));
  return make_plans(dry);
}

/// Lowers programs without running them, to learn their sizes and the order in which an act reads matrices.
Result<WeightPlan> Engine::plan_weights(std::size_t budget) {
  VLA_CHECK(build({}, true));
  VLA_TRY(const Plan* largest, plans_->for_shape(robot().network(), robot().largest_shape()));
  budget_.size = budget, budget_.process = device_->is_host() ? resident_size() : 0;
  const std::size_t others = budget_.process + memory().total() - device_->weights_size();
  VLA_TRY(WeightPlan plan,
          device_->plan_weights(largest->prefix(), largest->step(), budget > others ? budget - others : 0));
  plans_.reset();
  budget_.smallest = others + plan.smallest + (device_->is_host() ? kProcessesDiffer : 0);
  budget_.n_read = plan.n_read;
  if (budget >= others + plan.smallest) return plan;
  return Error{Code::out_of_memory, "memory",
               fmt::format("{:.0f} MB or more", std::ceil(1e-6 * static_cast<double>(budget_.smallest))),
               fmt::format("{:.0f} MB", 1e-6 * static_cast<double>(budget)),
               "give more, or make the bundle smaller with vla quantize"};
}

/// Builds the largest plan of every robot, so the working memory is known before the first request and does not grow
/// later.
Status Engine::make_plans(bool dry) {
  plans_.emplace(PlanContext{*device_, tap_pattern_, dry, nullptr, see_graph_, see_tap_});
  for (const auto& robot : robots_)
    if (const auto plan = plans_->for_shape(robot->network(), robot->largest_shape()); !plan) return plan.error();
  // Injected values fit one input shape only, so plans with them are built when an observation arrives.
  if (!injected_.empty()) plans_.emplace(PlanContext{*device_, tap_pattern_, dry, &injected_, {}, see_tap_});
  return {};
}

std::vector<const Robot*> Engine::robots() const {
  std::vector<const Robot*> all;
  for (const auto& robot : robots_) all.push_back(robot.get());
  return all;
}

Result<const Robot*> Engine::robot(const std::string& tag) const {
  std::vector<std::string> tags;
  for (const auto& robot : robots_) {
    if (tag == robot->bundle().embodiment() || (tag.empty() && robots_.size() == 1))
      return static_cast<const Robot*>(robot.get());
    tags.push_back(robot->bundle().embodiment());
  }
  if (tags.front().empty())
    return Error{Code::bad_observation, "embodiment", "none, since the policy is for one robot, which it does not name",
                 tag, "leave it out"};
  return Error{Code::bad_observation, "embodiment", fmt::format("one of {}", fmt::join(tags, ", ")),
               tag.empty() ? "none" : tag, "name the robot that the observation is of"};
}

/// Divides injected values into those of the network and those of its inputs. Tokens and results cannot be injected.
Status Engine::take_injected(const std::vector<Tap>& given) {
  for (const Tap& tap : given) {
    if (tap.path == "chunk" || tap.path == "actions" || tap.path == "tokens")
      return Error{Code::bad_observation, "injected " + tap.path, "a value of the network, pixels or state",
                   tap.path == "tokens" ? "what the instruction gives" : "a result"};
    (tap.path == "pixels" || tap.path == "state" ? injected_input_ : injected_).push_back(tap);
  }
  return {};
}

Status Engine::inject_inputs(Inputs& inputs) const {
  for (const Tap& tap : injected_input_) {
    const std::span<float> input = tap.path == "state" ? std::span(inputs.state) : std::span(inputs.pixels);
    if (tap.values.size() != input.size())
      return Error{Code::bad_observation, "injected " + tap.path, fmt::format("{} numbers", input.size()),
                   std::to_string(tap.values.size())};
    std::ranges::copy(tap.values, input.begin());
  }
  for (const auto* taps : {&injected_input_, &injected_})
    for (const Tap& tap : *taps) inputs.notes.push_back(tap.path + " was injected, not computed");
  return {};
}

Status Engine::set_steps(int n_step) {
  VLA_CHECK(robots_.front()->set_steps(n_step, *device_, dry_));
  last_.reset();
  return make_plans(dry_);
}

template <class Values>
void Engine::record(std::vector<Tap>& taps, const char* path, std::vector<std::int64_t> shape,
                    const Values& values) const {
  if (match_path(tap_pattern_, path)) taps.push_back({path, std::move(shape), {values.begin(), values.end()}});
}

Result<std::string> Engine::find_not_finite(const Observation& observation, const Noise& noise) {
  std::string found;
  const TapVisitor find = [&found](const std::string& path, auto, std::span<const float> values) {
    if (found.empty() && !std::ranges::all_of(values, [](float value) { return std::isfinite(value); })) found = path;
  };
  const std::string pattern = std::exchange(tap_pattern_, "*");
  const TapVisitor see = std::exchange(see_tap_, find);
  plans_.emplace(PlanContext{*device_, tap_pattern_, dry_, injected_.empty() ? nullptr : &injected_, {}, see_tap_});
  const Result<ActionChunk> chunk = act(observation, noise);
  tap_pattern_ = pattern, see_tap_ = see;
  last_.reset();
  VLA_CHECK(make_plans(dry_));
  return chunk || chunk.error().code == Code::bad_action ? Result(found) : chunk.error();
}

Result<std::string> Engine::program_text(Part part) {
  VLA_TRY(const Plan* plan, plans_->for_shape(robot().network(), robot().largest_shape()));
  return (part == Part::prefix ? plan->prefix() : plan->step()).text();
}

Result<StagePredictions> Engine::predict() {
  if (!dry_) return StagePredictions();  // predicting overwrites the working memory
  VLA_TRY(const Plan* plan, plans_->for_shape(robot().network(), robot().largest_shape()));
  return plan->predict(robot().solver().n_run());
}

Result<ActionChunk> Engine::act(const Observation& observation, const Noise& noise,
                                const std::optional<Leftover>& leftover) noexcept {
  VLA_CHECK(encode(observation, noise, leftover, encoded_));
  return compute(encoded_);
}

Status Engine::encode(const Observation& observation, const Noise& noise, const std::optional<Leftover>& leftover,
                      EncodedObservation& to) const noexcept try {
  to.pixels_ahead.reset(), to.is_late = {};
  to.inputs.pixels.take_from([device = device_.get()](std::size_t n) { return device->host_memory(n); });
  VLA_TRY(to.robot, robot(observation.embodiment));
  VLA_CHECK(to.robot->encode(observation, noise, leftover, to,
                             [this](std::size_t n, const auto& item) { host_threads_.run(n, item); }));
  return inject_inputs(to.inputs);
} catch (const std::bad_alloc&) {
  return no_memory();
}

Status Engine::send_ahead(EncodedObservation& encoded) const noexcept try {
  const Pixels& pixels = encoded.inputs.pixels;
  if (!pixels.empty()) encoded.pixels_ahead = device_->send(pixels.data(), pixels.size() * sizeof(float));
  return {};
} catch (const std::bad_alloc&) {
  return no_memory();
}

Result<ActionChunk> Engine::compute(EncodedObservation& encoded) noexcept try {
  return run(encoded);
} catch (const std::bad_alloc&) {
  return no_memory();
}

std::optional<ActShape> Engine::last_shape() const {
  if (!last_) return {};
  return ActShape{last_->first->bundle().embodiment(), last_->second};
}

Status Engine::warm_up(const ActShape& act) noexcept try {
  VLA_TRY(const Robot* of, robot(act.embodiment));
  VLA_TRY(const EncodedObservation zeros, of->zeros(act.inputs));
  VLA_TRY(Plan * plan, plans_->for_shape(of->network(), act.inputs));
  set_inputs(*plan, zeros);
  std::vector<Tap> taps;
  const Solver& solver = of->solver();
  VLA_CHECK(solve(*plan, solver.decodes ? 1 : solver.n_step, {}, taps));  // one token is enough: all cost the same
  static_cast<void>(plan->x());                                           // waits for the device
  return device_->failure();
} catch (const std::bad_alloc&) {
  return no_memory();
}

/// Runs the prefix and at most `most` steps on the inputs that were set. Errors: late, if `is_late` returns true before
/// a step.
Status Engine::solve(Plan& plan, int most, const std::function<bool()>& is_late, std::vector<Tap>& taps) {
  VLA_CHECK(plan.run_prefix(taps));
  for (int k = 0; k < most; ++k) {
    VLA_TRY(const bool needed, plan.needs_step(k));
    if (!needed) break;
    if (is_late && is_late())
      return Error{Code::late, "deadline_ms", "an answer in time", fmt::format("{} of its tokens", k + 1),
                   "ask less often, or allow more time"};
    VLA_CHECK(plan.run_step(k));
    plan.collect_step_taps(k, taps);
  }
  return {};
}

/// Passes recorded values to the callback, if one is set, and drops them.
void Engine::show(std::vector<Tap>& taps) const {
  if (!see_tap_) return;
  for (const Tap& tap : taps) see_tap_(tap.path, tap.shape, tap.values);
  taps.clear();
}

Result<ActionChunk> Engine::run(EncodedObservation& encoded) {
  const Robot& robot = *encoded.robot;
  const Inputs& in = encoded.inputs;
  StageClock clock;
  Timing timing = std::move(encoded.timing);
  std::vector<Tap> taps;
  last_ = {&robot, robot.shape_of(encoded)};
  VLA_TRY(Plan * plan, plans_->for_shape(robot.network(), last_->second));
  set_inputs(*plan, encoded);
  if (in.n_view > 0) record(taps, "pixels", {in.width, in.height, 3, in.n_view}, in.pixels);
  if (!in.tokens.empty()) record(taps, "tokens", {static_cast<std::int64_t>(in.tokens.size())}, in.tokens);
  if (!in.state.empty()) record(taps, "state", {static_cast<std::int64_t>(in.state.size())}, in.state);
  clock.lap(timing, "plan");
  VLA_CHECK(solve(*plan, robot.solver().n_step, robot.solver().decodes ? encoded.is_late : nullptr, taps));
  const std::vector<float> x = plan->x();  // on devices other than the CPU, this waits for the result
  VLA_CHECK(device_->failure());
  if (robot.solver().decodes) record(taps, "tokens_out", {static_cast<std::int64_t>(x.size())}, x);
  encoded.pixels_ahead.reset();
  for (const Program::Stage& stage : plan->prefix_stages()) clock.lap(timing, stage.name, stage.done);
  clock.lap(timing, "prefix", plan->prefix_ended());
  clock.lap(timing, "steps");
  show(taps);
  VLA_TRY(ActionChunk chunk, robot.decode(x, in));
  clock.lap(timing, "postprocess");
  record(taps, "chunk", {chunk.d_action, chunk.horizon}, chunk.normalized);
  record(taps, "actions", {chunk.d_action, chunk.horizon}, chunk.actions);  // the same in world units
  show(taps);
  chunk.timing = std::move(timing), chunk.taps = std::move(taps);
  return chunk;
}

StageWork Engine::work() const {
  const Plan* plan = last_ ? plans_->find(last_->first->network(), last_->second) : nullptr;
  return plan != nullptr ? plan->work(last_->first->solver().n_run()) : StageWork();
}

bool Engine::has_ternary() const {
  const auto is_ternary = [](const Param& param) { return param.encoding.type == DType::ternary; };
  return std::any_of(params().params().begin(), params().params().end(), is_ternary);
}

Precision Engine::precision() const { return has_ternary() ? Precision::int8 : device_->precision(); }

std::string Engine::arithmetic() const {
  const Precision floats = device_->precision();
  if (floats == Precision::int8)
    return device_->rounding() == Rounding::int8 || device_->rounding() == Rounding::int4
               ? "int8 products, as asked for: less exact than PyTorch's bf16"
               : "int8 products, as the bundle is quantized; --kernels float32 makes float32 of its codes";
  if (has_int8_products()) return fmt::format("ternary products of int8, others {}", precision_name(floats));
  const auto n_rounded = std::ranges::count_if(
      params().params(), [](const Param& param) { return param.encoding != resident_encoding(param, Rounding::bf16); });
  if (floats == Precision::bf16) {
    const bool rounds = n_rounded > 0 && device_->rounding() == Rounding::bf16;
    const std::string rounded = rounds ? fmt::format(" ({} matrices rounded to it, as asked for)", n_rounded) : "";
    return fmt::format("bf16 products{}, sums in float32; --kernels float32 avoids them", rounded);
  }
  const bool could = n_rounded > 0 && !chose_kernels_ && device_->has_bf16();
  return could ? fmt::format("float32; --kernels bf16 is faster and rounds {} matrices", n_rounded) : "float32";
}

MemoryUse Engine::memory() const {
  MemoryUse use = {device_->weights_size(), plans_->size(), device_->working_size()};
  for (const auto& robot : robots_) use.weights += robot->constants_size();
  return use;
}

}  // namespace vla
