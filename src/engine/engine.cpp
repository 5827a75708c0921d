// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/engine.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cmath>
#include <iterator>
#include <new>

namespace vla {
namespace {

constexpr int kMaxHorizon = 4096;

/// Containers throw where there is no memory: the act fails, and the next one starts from scratch. The strings are
/// short enough to need no memory.
Error no_memory() { return {Code::out_of_memory, "act", "", "no memory left", "free memory"}; }

}  // namespace

Result<std::unique_ptr<Engine>> Engine::load(const std::string& path, const EngineOptions& options) {
  VLA_TRY(Bundle file, Bundle::open(path));
  VLA_TRY(std::vector<std::unique_ptr<Engine>> robots, open_robots(std::move(file), options));
  VLA_TRY(const std::shared_ptr<Device> device, open_device(options.n_thread, options.kernels, options.device));
  std::shared_ptr<ParamList> params;
  const auto all_plans = std::make_shared<std::vector<Plans*>>();
  for (const auto& robot : robots) {
    robot->device_ = device;
    robot->tap_pattern_ = options.tap_pattern;
    robot->dry_ = options.dry;
    robot->chose_kernels_ = !options.kernels.empty();
    robot->all_plans_ = all_plans;
    VLA_CHECK(robot->take_injected(options.inject));
    VLA_CHECK(robot->load_policy(params));
  }
  VLA_CHECK(device->load(*params, !options.dry));
  for (const auto& robot : robots) VLA_CHECK(robot->make_graphs());
  if (!options.dry) device->touch();
  std::unique_ptr<Engine> first = std::move(robots.front());
  first->others_.assign(std::move_iterator(robots.begin() + 1), std::move_iterator(robots.end()));
  return first;
}

/// Each with the bundle and the processor that it would have alone.
Result<std::vector<std::unique_ptr<Engine>>> Engine::open_robots(Bundle file, const EngineOptions& options) {
  std::vector<std::string> tags = {options.embodiment};
  if (options.all_robots && options.embodiment.empty() && !file.embodiments().empty()) tags = file.embodiments();
  std::vector<std::unique_ptr<Engine>> robots;
  for (const std::string& tag : tags) {
    Bundle bundle = robots.size() + 1 < tags.size() ? file : std::move(file);
    VLA_CHECK(bundle.choose(tag));
    const Engine* first = robots.empty() ? nullptr : robots.front().get();
    const bool same_text = first != nullptr && bundle.keys().same("tokenizer.", first->bundle_.keys()) &&
                           bundle.keys().same("lm.n_vocab", first->bundle_.keys());
    VLA_TRY(Processor processor, Processor::create(bundle, same_text ? first->processor_.tokenizer() : nullptr));
    if (first != nullptr) bundle.forget("tokenizer.");
    robots.emplace_back(new Engine(std::move(bundle), std::move(processor)));
  }
  robots.front()->bundle_.forget("tokenizer.");  // with it the others were compared
  return robots;
}

void Engine::refuse_beyond() {
  processor_.refuse_beyond();
  for (const auto& other : others_) other->refuse_beyond();
}

std::vector<const Engine*> Engine::robots() const {
  std::vector<const Engine*> all = {this};
  for (const auto& other : others_) all.push_back(other.get());
  return all;
}

Result<const Engine*> Engine::robot(const std::string& tag) const {
  const std::string& own = bundle_.embodiment();
  if (tag == own || (tag.empty() && others_.empty())) return this;
  std::vector<std::string> tags = {own};
  for (const auto& other : others_) {
    if (other->bundle_.embodiment() == tag) return static_cast<const Engine*>(other.get());
    tags.push_back(other->bundle_.embodiment());
  }
  if (own.empty())
    return Error{Code::bad_observation, "embodiment", "none, since the policy is for one robot, which it does not name",
                 tag, "leave it out"};
  return Error{Code::bad_observation, "embodiment", fmt::format("one of {}", fmt::join(tags, ", ")),
               tag.empty() ? "none" : tag, "name the robot that the observation is of"};
}

/// `params`: those of the robots before this one, and null for the first.
Status Engine::load_policy(std::shared_ptr<ParamList>& params) {
  const Keys& keys = bundle_.keys();
  VLA_TRY(const std::string arch, keys.string("vla.arch"));
  VLA_TRY(const PolicyEntry entry, find_policy(arch));
  if (params == nullptr)
    params = std::make_shared<ParamList>(keys, &bundle_);
  else
    params->go_on(bundle_);
  params_ = params;
  policy_ = entry.make(*params_);
  VLA_CHECK(params_->report(arch, [this](const std::string& tensor) { return processor_.reads(tensor); }));
  VLA_TRY(solver_, Solver::read(keys));
  VLA_TRY(horizon_, keys.integer("policy.horizon", {1, kMaxHorizon}));
  VLA_TRY(d_action_, keys.integer("policy.d_action", {1, kMaxVector}));
  VLA_TRY(d_state_, keys.integer("policy.d_state", {0, kMaxVector}));
  return {};
}

/// When weights are loaded.
Status Engine::make_graphs() {
  VLA_CHECK(make_conditions());
  VLA_CHECK(make_constants());
  return make_plans();
}

/// Load rate: lowers a graph that is used once, and runs it.
Status Engine::run_once(const Graph& graph) {
  VLA_CHECK(device_->allocate(graph.slots()));
  VLA_TRY(const std::unique_ptr<Program> program, device_->lower(graph));
  return dry_ ? Status() : program->run();
}

/// Load rate: the table of everything that depends on the time alone.
Status Engine::make_conditions() {
  tables_ = std::make_unique<Slots>();
  conditions_ = nullptr;
  Graph graph(*tables_);
  const Tensor computed = policy_->condition(graph, solver_.times);
  if (!computed) return {};
  Slot* table = tables_->add_f32(computed.shape());
  graph.write(computed, table);
  conditions_ = table;
  return run_once(graph);
}

InputShape Engine::largest_shape() const {
  const Recipe& recipe = processor_.recipe();
  const int n_view = static_cast<int>(processor_.views().names().size());
  return {recipe.width,      recipe.height, n_view,
          recipe.max_tokens, d_state_,      placed(static_cast<std::uint32_t>((std::uint64_t{1} << n_view) - 1))};
}

/// The views of a shape: shapes that are the same for the policy must be equal.
std::uint32_t Engine::placed(std::uint32_t views) const { return policy_->places_views() ? views : 0; }

/// Load rate: what every prefix needs and the weights alone decide, for policies that have such a thing.
Status Engine::make_constants() {
  const Recipe& recipe = processor_.recipe();
  VLA_CHECK(policy_->check(largest_shape()));
  constant_slots_ = std::make_unique<Slots>();
  Graph graph(*constant_slots_);
  const auto absent_view = [&] {
    return graph.constant(processor_.absent_view(), {recipe.width, recipe.height, 3, 1});
  };
  policy_->constants(graph, absent_view, constants_);
  return graph.nodes().empty() ? Status() : run_once(graph);
}

/// Builds the largest plan, so that the working memory is known before the first request and does not grow after it.
Status Engine::make_plans() {
  last_shape_.reset();
  plans_ = std::make_unique<Plans>(
      PlanContext{*policy_, *device_, solver_, conditions_, constants_, d_action_, horizon_, tap_pattern_, dry_},
      all_plans_);
  const auto plan = plans_->for_shape(largest_shape());
  if (!plan) return plan.error();
  if (injected_.empty()) return {};
  plans_ = std::make_unique<Plans>(PlanContext{*policy_, *device_, solver_, conditions_, constants_, d_action_,
                                               horizon_, tap_pattern_, dry_, &injected_},
                                   all_plans_);  // fits the shape of its observation
  return {};
}

/// What the host reads and writes has names too, beside those of the network.
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
    std::vector<float>& input = tap.path == "state" ? inputs.state : inputs.pixels;
    if (tap.values.size() != input.size())
      return Error{Code::bad_observation, "injected " + tap.path, fmt::format("{} numbers", input.size()),
                   std::to_string(tap.values.size())};
    input = tap.values;
  }
  return {};
}

Status Engine::set_steps(int n_step) {
  Keys keys = bundle_.keys();
  keys.set("solver.steps", std::int64_t{n_step});
  VLA_TRY(solver_, Solver::read(keys));
  VLA_CHECK(make_conditions());
  return make_plans();
}

Result<std::vector<float>> Engine::start(const Noise& noise) const {
  const std::size_t count = static_cast<std::size_t>(horizon_) * static_cast<std::size_t>(d_action_);
  if (const auto* seed = std::get_if<std::uint64_t>(&noise)) return draw_noise(solver_.noise, *seed, count);
  const auto& values = std::get<std::vector<float>>(noise);
  if (values.size() != count)
    return Error{Code::bad_observation, "noise", fmt::format("{} x {} numbers", horizon_, d_action_),
                 fmt::format("{} numbers", values.size())};
  for (float value : values)
    if (!std::isfinite(value)) return Error{Code::bad_observation, "noise", "finite numbers", fmt::format("{}", value)};
  return values;
}

template <class T>
void Engine::record(std::vector<Tap>& taps, const char* path, std::vector<std::int64_t> shape,
                    const std::vector<T>& values) const {
  if (match_path(tap_pattern_, path)) taps.push_back({path, std::move(shape), {values.begin(), values.end()}});
}

void Engine::record_inputs(std::vector<Tap>& taps, const Inputs& inputs) const {
  record(taps, "pixels", {inputs.width, inputs.height, 3, inputs.n_view}, inputs.pixels);
  record(taps, "tokens", {static_cast<std::int64_t>(inputs.tokens.size())}, inputs.tokens);
  if (d_state_ > 0) record(taps, "state", {d_state_}, inputs.state);
}

ChunkShape Engine::chunk_shape() const {
  return {horizon_, d_action_, horizon(), static_cast<int>(processor_.action_names().size())};
}

RealTimeChunking Engine::real_time_chunking() const {
  return processor_.relative_actions() ? RealTimeChunking() : policy_->real_time_chunking();
}

/// What the network answers, cut to the robot's rows and columns.
std::vector<float> Engine::normalized(const std::vector<float>& x) const {
  const ChunkShape shape = chunk_shape();
  std::vector<float> cut;
  for (int row = 0; row < shape.n_row; ++row)
    cut.insert(cut.end(), x.begin() + row * d_action_, x.begin() + row * d_action_ + shape.d_normalized);
  return cut;
}

/// `actions` is the same as `chunk`, in world units.
void Engine::record_chunk(ActionChunk& chunk) const {
  record(chunk.taps, "chunk", {chunk.d_action, chunk.horizon}, chunk.normalized);
  record(chunk.taps, "actions", {chunk.d_action, chunk.horizon}, chunk.actions);
}

Result<std::string> Engine::program_text(Part part) {
  VLA_TRY(const Plan* plan, plans_->for_shape(largest_shape()));
  return (part == Part::prefix ? plan->prefix() : plan->step()).text();
}

Result<ActionChunk> Engine::act(const Observation& observation, const Noise& noise,
                                const std::optional<Leftover>& leftover) noexcept {
  VLA_CHECK(prepare(observation, noise, leftover, prepared_));
  return act(prepared_);
}

Status Engine::prepare(const Observation& observation, const Noise& noise, const std::optional<Leftover>& leftover,
                       Prepared& to) const noexcept try {
  VLA_TRY(to.robot, robot(observation.embodiment));
  return to.robot->encode(observation, noise, leftover, to);
} catch (const std::bad_alloc&) {
  return no_memory();
}

Result<ActionChunk> Engine::act(Prepared& prepared) noexcept try {
  for (const auto& other : others_)
    if (other.get() == prepared.robot) return other->run(prepared);
  return run(prepared);
} catch (const std::bad_alloc&) {
  return no_memory();
}

Status Engine::encode(const Observation& observation, const Noise& noise, const std::optional<Leftover>& leftover,
                      Prepared& to) const {
  StageClock clock;
  to.timing.clear(), to.steering.reset();
  VLA_CHECK(processor_.encode_images(observation, to.inputs));
  VLA_CHECK(processor_.encode_state(observation, to.inputs));
  clock.lap(to.timing, "preprocess");
  VLA_CHECK(processor_.encode_text(observation, to.inputs));
  VLA_CHECK(inject_inputs(to.inputs));
  VLA_TRY(to.x, start(noise));
  if (leftover) {
    VLA_TRY(to.steering, steer(real_time_chunking(), solver_, *leftover, chunk_shape(), std::move(to.x)));
    VLA_CHECK(check_leftover(*leftover, to.inputs));
  }
  clock.lap(to.timing, "tokenize");
  return {};
}

/// Rows far from the training data pull the whole chunk there: most often they are in world units.
Status Engine::check_leftover(const Leftover& leftover, Inputs& inputs) const {
  const std::optional<std::string> far = processor_.far_action(leftover.rows);
  if (!far) return {};
  if (processor_.refuses_beyond())
    return Error{Code::bad_observation, "leftover", fmt::format("at most {} when normalized", kStateBound), *far,
                 "send rows of ActionChunk::normalized, not actions in world units"};
  inputs.is_beyond = true;
  inputs.notes.push_back(fmt::format("leftover{}; more than {} is far from what the policy gives", *far, kStateBound));
  return {};
}

Result<ActionChunk> Engine::run(Prepared& prepared) {
  const Inputs& inputs = prepared.inputs;
  const std::optional<Steering>& steering = prepared.steering;
  ActionChunk chunk;
  StageClock clock;
  chunk.timing = std::move(prepared.timing);
  last_shape_ = {inputs.width, inputs.height,        inputs.n_view,       static_cast<int>(inputs.tokens.size()),
                 d_state_,     placed(inputs.views), steering.has_value()};
  VLA_TRY(Plan * plan, plans_->for_shape(*last_shape_));
  plan->set_inputs(inputs.pixels, inputs.tokens, inputs.state);
  plan->set_x(steering ? steering->start : prepared.x);
  if (steering) plan->set_steering(*steering);
  record_inputs(chunk.taps, inputs);
  clock.lap(chunk.timing, "plan");
  VLA_CHECK(plan->run_prefix(chunk.taps));
  for (const Program::Stage& stage : plan->prefix_stages()) clock.lap(chunk.timing, stage.name, stage.done);
  clock.lap(chunk.timing, "prefix");
  for (int k = 0; k < solver_.n_step; ++k) {
    VLA_CHECK(plan->run_step(k));
    plan->collect_step_taps(k, chunk.taps);
  }
  clock.lap(chunk.timing, "steps");
  const std::vector<float> result = plan->x();
  VLA_CHECK(device_->failure());
  VLA_TRY(chunk.actions, processor_.decode(result, horizon_, d_action_, inputs.raw_state));
  clock.lap(chunk.timing, "postprocess");
  chunk.horizon = horizon();
  chunk.d_action = static_cast<int>(processor_.action_names().size());
  chunk.normalized = normalized(result);
  chunk.notes = inputs.notes;
  for (const auto* taps : {&injected_input_, &injected_})
    for (const Tap& tap : *taps) chunk.notes.push_back(tap.path + " was injected, not computed");
  if (const std::optional<std::string> far = processor_.far_action(chunk.normalized))
    chunk.notes.push_back(fmt::format("actions{}; more than {} is far from the training data", *far, kStateBound));
  chunk.is_beyond = inputs.is_beyond;
  record_chunk(chunk);
  return chunk;
}

StageWork Engine::work() const {
  const Plan* plan = last_shape_ ? plans_->find(*last_shape_) : nullptr;
  return plan != nullptr ? plan->work(solver_.n_step) : StageWork();
}

bool Engine::has_ternary() const {
  const auto is_ternary = [](const Param& param) { return param.storage == Storage::ternary; };
  return std::any_of(params_->params().begin(), params_->params().end(), is_ternary);
}

Precision Engine::precision() const { return has_ternary() ? Precision::int8 : device_->precision(); }

std::string Engine::arithmetic() const {
  const Precision floats = device_->precision();
  if (floats == Precision::int8) return "int8 products, as asked for: less exact than PyTorch's bf16";
  if (has_int8_products()) return fmt::format("ternary products of int8, others {}", precision_name(floats));
  const auto n_rounded = std::ranges::count_if(params_->params(), [](const Param& param) {
    return param.type() != DType::bf16 && resident_dtype(param, Rounding::bf16) == DType::bf16;
  });
  if (floats == Precision::bf16) {
    const bool rounds = n_rounded > 0 && device_->rounding() == Rounding::bf16;
    const std::string rounded = rounds ? fmt::format(" ({} matrices rounded to it, as asked for)", n_rounded) : "";
    return fmt::format("bf16 products{}, sums in float32; --kernels float32 avoids them", rounded);
  }
  const bool could = n_rounded > 0 && !chose_kernels_ && device_->has_bf16();
  return could ? fmt::format("float32; --kernels bf16 is faster and rounds {} matrices", n_rounded) : "float32";
}

MemoryUse Engine::memory() const {
  MemoryUse use = {device_->weights_size(), 0, device_->working_size()};
  const auto add = [&use](const Engine& robot) {
    use.weights += robot.tables_->size() + robot.constant_slots_->size();
    use.plan += robot.plans_->size();
  };
  add(*this);
  for (const auto& other : others_) add(*other);
  return use;
}

}  // namespace vla
