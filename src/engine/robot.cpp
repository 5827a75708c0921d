// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/robot.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

namespace vla {
namespace {

constexpr int kMaxHorizon = 4096;

/// Selects the taps that `see_tap` receives. Without `see_tap` it selects none, because no act returns taps of the
/// graphs that run at load.
TapFilter filter_of(const PlanContext& context) {
  if (!context.see_tap) return {};
  return [pattern = context.tap_pattern](const std::string& path) { return match_path(pattern, path); };
}

/// Load rate: lowers a graph, runs it once and drops it.
Status run_once(const Graph& graph, const PlanContext& context) {
  if (context.see_graph) context.see_graph(graph);
  VLA_CHECK(context.device.allocate(graph.slots()));
  VLA_TRY(const std::unique_ptr<Program> program,
          context.device.lower(graph, {.varying = {}, .see_tap = context.see_tap}));
  return context.dry ? Status() : program->run();
}

}  // namespace

Robot::Robot(Bundle bundle, Processor processor, const Robot* other)
    : bundle_(std::move(bundle)),
      processor_(std::move(processor)),
      params_(other != nullptr ? ParamList(bundle_, other->params_) : ParamList(bundle_.keys(), &bundle_)) {}

Result<std::unique_ptr<Robot>> Robot::open(Bundle bundle, const Robot* other) {
  const bool same_text = other != nullptr && bundle.keys().same("tokenizer.", other->bundle_.keys()) &&
                         bundle.keys().same("lm.n_vocab", other->bundle_.keys());
  VLA_TRY(Processor processor, Processor::create(bundle, same_text ? other->processor_.tokenizer() : nullptr));
  std::unique_ptr<Robot> robot(new Robot(std::move(bundle), std::move(processor), other));
  VLA_CHECK(robot->read_policy());
  return robot;
}

Status Robot::read_policy() {
  const Keys& keys = bundle_.keys();
  VLA_TRY(const std::string arch, keys.string("vla.arch"));
  VLA_TRY(const PolicyEntry entry, find_policy(arch));
  policy_ = entry.make(params_);
  VLA_CHECK(params_.report(arch, [this](const std::string& tensor) { return processor_.reads(tensor); }));
  VLA_TRY(solver_, Solver::read(keys));
  VLA_TRY(horizon_, keys.integer("policy.horizon", {1, kMaxHorizon}));
  VLA_TRY(d_action_, keys.integer("policy.d_action", {1, kMaxVector}));
  VLA_TRY(d_state_, keys.integer("policy.d_state", {0, kMaxVector}));
  if (solver_.decodes != processor_.action_tokens().has_value())
    return Error{Code::bad_bundle, "action_tokens.kind", "one where solver.kind is greedy, and only there",
                 solver_.decodes ? "none" : "one"};
  return policy_->check(largest_shape());
}

Status Robot::compute_constants(const PlanContext& context) {
  VLA_CHECK(make_conditions(context));
  constant_slots_ = Slots(), constants_ = Cache();
  const Recipe& recipe = processor_.recipe();
  Graph graph(constant_slots_, filter_of(context));
  const auto absent_view = [&] {
    return graph.constant(processor_.absent_view(), {recipe.width, recipe.height, 3, 1});
  };
  policy_->constants(graph, absent_view, constants_);
  return graph.nodes().empty() ? Status() : run_once(graph, context);
}

/// Computes the table of the values that depend only on time.
Status Robot::make_conditions(const PlanContext& context) {
  tables_ = Slots();
  conditions_ = nullptr;
  Graph graph(tables_, filter_of(context));
  const Tensor computed = policy_->condition(graph, solver_.times);
  if (!computed) return {};
  Slot* table = tables_.add_f32(computed.shape());
  graph.write(computed, table);
  conditions_ = table;
  return run_once(graph, context);
}

Status Robot::set_steps(int n_step, Device& device, bool dry) {
  Keys keys = bundle_.keys();
  keys.set("solver.steps", std::int64_t{n_step});
  VLA_TRY(solver_, Solver::read(keys));
  return make_conditions({device, {}, dry});
}

InputShape Robot::largest_shape() const {
  const Recipe& recipe = processor_.recipe();
  const int n_view = static_cast<int>(processor_.views().names().size());
  return {.width = recipe.width,
          .height = recipe.height,
          .n_view = n_view,
          .n_text = recipe.max_tokens,
          .d_state = d_state_,
          .views = view_key(n_view > 0 ? ~std::uint64_t{0} >> (64 - n_view) : 0)};
}

InputShape Robot::shape_of(const EncodedObservation& observation) const {
  const Inputs& in = observation.inputs;
  return {.width = in.width,
          .height = in.height,
          .n_view = in.n_view,
          .n_text = static_cast<int>(in.tokens.size()),
          .d_state = d_state_,
          .views = view_key(in.views),
          .steered = observation.steering.has_value(),
          .text = policy_->text_layout(in.tokens)};
}

/// The part of a shape that identifies the views; 0 if the policy builds the same graph for all views.
std::uint64_t Robot::view_key(std::uint64_t views) const { return policy_->depends_on_which_views() ? views : 0; }

RealTimeChunking Robot::real_time_chunking() const {
  return processor_.relative_actions() ? RealTimeChunking() : policy_->real_time_chunking();
}

ChunkShape Robot::chunk_shape() const {
  return {horizon_, d_action_, horizon(), static_cast<int>(processor_.action_names().size())};
}

Status Robot::encode(const Observation& observation, const Noise& noise, const std::optional<Leftover>& leftover,
                     EncodedObservation& to, const RunItems& run) const {
  StageClock clock;
  to.timing.clear(), to.steering.reset();
  VLA_CHECK(processor_.encode_images(observation, to.inputs, run));
  VLA_CHECK(processor_.encode_state(observation, to.inputs));
  clock.lap(to.timing, "preprocess");
  VLA_CHECK(processor_.encode_text(observation, to.inputs));
  VLA_TRY(to.noise, values_of(noise));
  if (leftover) {
    VLA_TRY(to.steering, steer(real_time_chunking(), solver_, *leftover, chunk_shape(), std::move(to.noise)));
    VLA_CHECK(check_leftover(observation, *leftover, to.inputs));
  }
  clock.lap(to.timing, "tokenize");
  return {};
}

Result<EncodedObservation> Robot::zeros(const InputShape& shape) const {
  const InputShape most = largest_shape();
  const bool fits = shape.width == most.width && shape.height == most.height && shape.d_state == most.d_state &&
                    shape.n_view >= std::min(1, most.n_view) && shape.n_view <= most.n_view && shape.n_text >= 0 &&
                    shape.n_text <= most.n_text && view_key(shape.views) == shape.views &&
                    (!shape.steered || real_time_chunking().kind != RealTimeChunking::Kind::none);
  if (!fits)
    return Error{
        Code::bad_observation, "warm-up",
        fmt::format("{} x {}, up to {} views and {} tokens", most.width, most.height, most.n_view, most.n_text),
        fmt::format("{} x {}, {} views, {} tokens", shape.width, shape.height, shape.n_view, shape.n_text)};
  VLA_CHECK(policy_->check(shape));
  const auto size = [](std::int64_t n) { return static_cast<std::size_t>(n); };
  EncodedObservation to;
  to.robot = this;
  to.inputs.width = shape.width, to.inputs.height = shape.height;
  to.inputs.n_view = shape.n_view, to.inputs.views = shape.views;
  to.inputs.pixels.resize(size(std::int64_t{3} * shape.width * shape.height * shape.n_view));
  to.inputs.tokens.resize(size(shape.n_text)), to.inputs.state.resize(size(shape.d_state));
  to.noise.resize(size(std::int64_t{noise_rows()} * d_action_));
  if (shape.steered) {
    const std::vector<float> rates(size(std::int64_t{solver_.n_step} * horizon_));
    to.steering = Steering{to.noise, to.noise, rates, rates};
  }
  return to;
}

Result<std::vector<float>> Robot::values_of(const Noise& noise) const {
  const std::size_t count = static_cast<std::size_t>(noise_rows()) * static_cast<std::size_t>(d_action_);
  if (const auto* seed = std::get_if<std::uint64_t>(&noise)) return draw_noise(solver_.noise, *seed, count);
  const auto& values = std::get<std::vector<float>>(noise);
  if (values.size() != count)
    return Error{Code::bad_observation, "noise", fmt::format("{} x {} numbers", noise_rows(), d_action_),
                 fmt::format("{} numbers", values.size())};
  for (float value : values)
    if (!std::isfinite(value)) return Error{Code::bad_observation, "noise", "finite numbers", fmt::format("{}", value)};
  return values;
}

/// Rows far from the training data pull the whole chunk away. Usually they are in world units by mistake.
Status Robot::check_leftover(const Observation& observation, const Leftover& leftover, Inputs& inputs) const {
  const std::optional<std::string> far = processor_.far_action(leftover.rows);
  if (!far) return {};
  if (observation.reject_out_of_range)
    return Error{Code::bad_observation, "leftover", fmt::format("at most {} when normalized", kStateBound), *far,
                 "send rows of ActionChunk::normalized, not actions in world units"};
  inputs.out_of_range = true;
  inputs.notes.push_back(fmt::format("leftover{}; more than {} is far from what the policy gives", *far, kStateBound));
  return {};
}

/// Converts the network's answer to a normalized chunk: decodes action tokens, or returns the answer itself.
Result<std::vector<float>> Robot::normalized_chunk(const std::vector<float>& answer, std::string& note) const {
  if (!processor_.action_tokens()) return answer;
  const std::vector<std::int32_t> ids(answer.begin(), answer.end());
  return processor_.action_tokens()->decode(ids, horizon_, d_action_, &note);
}

Result<ActionChunk> Robot::decode(const std::vector<float>& answer, const Inputs& inputs) const {
  ActionChunk chunk;
  std::string note;
  VLA_TRY(const std::vector<float> x, normalized_chunk(answer, note));
  VLA_TRY(chunk.actions, processor_.decode(x, horizon_, d_action_, inputs.raw_state));
  const ChunkShape shape = chunk_shape();
  chunk.horizon = shape.n_row, chunk.d_action = shape.d_normalized;
  for (int row = processor_.first_row(); row < processor_.first_row() + shape.n_row; ++row)
    chunk.normalized.insert(chunk.normalized.end(), x.begin() + row * d_action_,
                            x.begin() + row * d_action_ + shape.d_normalized);
  chunk.notes = inputs.notes;
  if (!note.empty()) chunk.notes.push_back(note);
  if (const std::optional<std::string> far = processor_.far_action(chunk.normalized))
    chunk.notes.push_back(fmt::format("actions{}; more than {} is far from the training data", *far, kStateBound));
  chunk.out_of_range = inputs.out_of_range;
  return chunk;
}

}  // namespace vla
