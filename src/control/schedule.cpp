// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "control/schedule.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstdarg>
#include <cstdio>

namespace vla::control {

void tell(Problem& problem, std::string_view code, const char* format, ...) noexcept {
  std::snprintf(problem.code, sizeof problem.code, "%.*s", static_cast<int>(code.size()), code.data());
  va_list arguments;
  va_start(arguments, format);
  std::vsnprintf(problem.message, sizeof problem.message, format, arguments);
  va_end(arguments);
}

Blend Blend::linear(int fade_steps) {
  if (fade_steps < 0) throw Error("usage", "fade_steps", "0 or more", fmt::format("{}", fade_steps));
  Blend blend;
  blend.is_set_ = true, blend.fade_steps_ = fade_steps;
  return blend;
}

Blend Blend::ensemble(double decay) {
  if (!(decay >= 0) || std::isinf(decay))
    throw Error("usage", "decay", "a finite number, 0 or more", fmt::format("{:g}", decay));
  Blend blend;
  blend.is_set_ = blend.is_ensemble_ = true, blend.decay_ = decay;
  return blend;
}

Schedule::Schedule(Options options) : options_(std::move(options)) {
  const int horizon = options_.horizon, d = options_.d_action;
  if (!options_.blend.is_set_) throw Error("usage", "blend", "replace, linear or ensemble", "none");
  if (options_.late == Late::unset) throw Error("usage", "late", "hold, zero or stop", "none");
  if (!(1 <= options_.replan_every && options_.replan_every <= horizon))
    throw Error("usage", "replan_every", fmt::format("1 to {}, the rows of a chunk", horizon),
                fmt::format("{}", options_.replan_every));
  std::vector<float>& jump = options_.max_jump;
  if (options_.limiter != nullptr && !jump.empty())
    throw Error("usage", "max_jump", "none beside limits, which say how far a command may jump",
                fmt::format("{} numbers", jump.size()));
  const bool is_jump = std::all_of(jump.begin(), jump.end(), [](float most) { return most > 0; });
  if (!is_jump || (jump.size() > 1 && jump.size() != static_cast<std::size_t>(d)))
    throw Error("usage", "max_jump", fmt::format("a number above 0, or {} of them", d),
                fmt::format("{} numbers", jump.size()));
  if (jump.size() == 1) jump.resize(static_cast<std::size_t>(d), jump[0]);
  // At most one chunk arrives per step, and each serves `horizon` steps. Two more: a held command, and the chunk that
  // arrives.
  const std::size_t most = static_cast<std::size_t>(horizon) + 3,
                    n = static_cast<std::size_t>(horizon) * static_cast<std::size_t>(d);
  sources_.resize(most), order_.resize(most), weights_.resize(most);
  for (Source& source : sources_) source.rows.resize(n), source.normalized.resize(n);
  for (std::size_t i = 0; i < most; ++i) order_[i] = i;
  values_.resize(static_cast<std::size_t>(d)), last_.resize(static_cast<std::size_t>(d)),
      cut_.resize(static_cast<std::size_t>(d)), wanted_.resize(static_cast<std::size_t>(d));
  reset();
}

void Schedule::reset() noexcept {
  counts = {};
  if (options_.limiter != nullptr) options_.limiter->reset();
  n_source_ = 0;
  has_last_ = is_flying_ = is_stopped_ = false;
  step_ = 0, n_delay_ = 0;
}

int Schedule::delay() const noexcept {
  const auto n = static_cast<std::ptrdiff_t>(std::min<std::int64_t>(n_delay_, kDelays));
  return n == 0 ? -1 : *std::max_element(delays_.begin(), delays_.begin() + n);
}

std::span<const float> Schedule::leftover(int n_row) const noexcept {
  if (n_source_ == 0) return {};
  const Source& newest = source(n_source_ - 1);
  const std::int64_t first = step_ - newest.step, n = std::min<std::int64_t>(n_row, newest.n_row - first);
  if (!newest.has_normalized || n <= 0) return {};
  const auto d = static_cast<std::size_t>(options_.d_action);
  return std::span(newest.normalized).subspan(static_cast<std::size_t>(first) * d, static_cast<std::size_t>(n) * d);
}

bool Schedule::wants(std::int64_t tick) noexcept {
  begin(tick);
  if (is_flying_) return false;
  return n_source_ == 0 || step_ - source(n_source_ - 1).step >= options_.replan_every;
}

void Schedule::observe(std::int64_t tick) noexcept {
  begin(tick);
  is_flying_ = true, is_warm_ = n_source_ > 0, flight_step_ = step_, flight_tick_ = tick;
}

void Schedule::fail() noexcept {
  is_flying_ = false;
  ++counts.failed;
}

bool Schedule::receive(const Answer& answer, std::int64_t tick, Problem& problem) noexcept {
  begin(tick);
  is_flying_ = false;
  const int horizon = options_.horizon, d = options_.d_action;
  const std::size_t n = static_cast<std::size_t>(horizon) * static_cast<std::size_t>(d);
  const auto is_finite = [](float x) { return std::isfinite(x); };
  if (answer.horizon != horizon || answer.d_action != d || answer.rows.size() != n ||
      !std::all_of(answer.rows.begin(), answer.rows.end(), is_finite)) {
    tell(problem, "bad_action", "chunk: expected (%d, %d) finite numbers, found (%d, %d) or one that is not", horizon,
         d, answer.horizon, answer.d_action);
    return false;
  }
  if (options_.limiter != nullptr) {
    int first = -1;
    const int n_broken = options_.limiter->breaks(answer.rows, first);
    if (static_cast<double>(n_broken) / horizon > options_.limiter->refuse_above()) {
      ++counts.refused;
      tell(problem, "bad_action",
           "chunk: expected at most a share of %g of its rows outside of the limits, found %d of %d, the first of them "
           "row %d; "
           "statistics, units or the order of columns may be another robot's",
           options_.limiter->refuse_above(), n_broken, horizon, first);
      return false;
    }
  }
  if (is_warm_) delays_[static_cast<std::size_t>(n_delay_++ % kDelays)] = static_cast<int>(step_ - flight_step_);
  ++counts.chunks;
  if (!is_admissible(flight_step_, flight_tick_, horizon, tick)) {
    ++counts.stale;
    return true;
  }
  const int fade = make_fade(tick);
  Source& source = add_source();
  source.step = flight_step_, source.tick = flight_tick_, source.entered = step_, source.n_row = horizon,
  source.fade = fade;
  source.is_held = false, source.has_normalized = answer.normalized.size() == n;
  std::copy(answer.rows.begin(), answer.rows.end(), source.rows.begin());
  if (source.has_normalized) std::copy(answer.normalized.begin(), answer.normalized.end(), source.normalized.begin());
  return true;
}

Action Schedule::next(std::int64_t tick, std::span<const float> human) noexcept {
  Action action = {.tick = tick};
  if (!may_act(tick, action)) return action;
  const bool is_human = !human.empty();
  if (!is_human && n_source_ == 0) return held(tick);
  action.state = ActionState::command, action.human = is_human;
  if (n_source_ > 0) {
    weigh();
    for (std::size_t i = 0; i < n_source_; ++i)
      if (weights_[i] > 0 && !source(i).is_held) action.age = std::max(action.age, tick - source(i).tick);
    mix(is_human ? wanted_ : values_);
    if (is_human) action.policy = wanted_;
  }
  if (is_human) std::copy(human.begin(), human.end(), values_.begin());
  action.values = values_;
  limit(action);
  ++step_, ++(is_human ? counts.human : counts.actions);
  counts.limited += action.limited;
  return action;
}

Action Schedule::hold(std::int64_t tick) noexcept {
  Action action = {.tick = tick};
  return may_act(tick, action) ? held(tick) : action;
}

/// Begins the tick's action. Returns false if the loop is stopped, or if the limiter does not know where the robot is.
bool Schedule::may_act(std::int64_t tick, Action& action) noexcept {
  begin(tick);
  action.problem = &stop_;
  action.state = ActionState::stopped;
  if (is_stopped_) return false;
  action.state = ActionState::failed;
  if (options_.limiter != nullptr && !options_.limiter->is_ready()) {
    tell(stop_, "usage", "limits: expected where the robot is: start_at of the loop, found nothing");
    return false;
  }
  action.problem = nullptr;
  return true;
}

/// Writes the weighted sum of the sources' rows for this step. A gripper takes the newest source's value: a mean of
/// opening and closing is neither.
void Schedule::mix(std::span<float> row) const noexcept {
  for (std::size_t column = 0; column < row.size(); ++column) {
    const bool is_gripper = options_.limiter != nullptr && options_.limiter->is_gripper(column);
    double sum = 0;
    for (std::size_t i = 0; i < n_source_; ++i) {
      if (!(weights_[i] > 0)) continue;
      const Source& each = source(i);
      const std::size_t at = each.is_held ? 0 : static_cast<std::size_t>(step_ - each.step);
      const auto value = static_cast<double>(each.rows[at * row.size() + column]);
      sum = is_gripper ? value : sum + weights_[i] * value;
    }
    row[column] = static_cast<float>(sum);
  }
}

/// Drops sources that have no admissible row for this tick. A held command only serves to fade out: without a chunk it
/// is dropped too.
void Schedule::begin(std::int64_t tick) noexcept {
  bool has_chunk = false;
  std::size_t n = 0;
  for (std::size_t i = 0; i < n_source_; ++i) {
    const Source& each = source(i);
    if (!is_admissible(each.step, each.is_held ? -1 : each.tick, each.n_row, tick)) continue;
    has_chunk |= !each.is_held;
    std::swap(order_[n++], order_[i]);
  }
  n_source_ = has_chunk ? n : 0;
}

bool Schedule::is_admissible(std::int64_t step, std::int64_t observed, int n_row, std::int64_t tick) const noexcept {
  const bool is_fresh = options_.max_age < 0 || observed < 0 || tick - observed <= options_.max_age;
  return is_fresh && step_ < step + n_row;
}

Schedule::Source& Schedule::add_source() noexcept { return sources_[order_[n_source_++]]; }

/// Returns the steps of a fade that begins now, at most the steps that the source to fade out has left. After a hold,
/// the held command becomes that source.
int Schedule::make_fade(std::int64_t tick) noexcept {
  std::int64_t fade = options_.blend.fade_steps_;
  if (n_source_ > 0) {
    const Source& newest = source(n_source_ - 1);
    fade = std::min(fade, newest.step + newest.n_row - step_);
    if (options_.max_age >= 0 && !newest.is_held) fade = std::min(fade, newest.tick + options_.max_age - tick + 1);
  } else if (!has_last_) {
    return 0;
  } else if (fade > 0) {
    Source& held = add_source();
    held.step = held.entered = step_, held.tick = -1, held.n_row = static_cast<int>(fade), held.fade = 0;
    held.is_held = true, held.has_normalized = false;
    std::copy(last_.begin(), last_.end(), held.rows.begin());
  }
  return static_cast<int>(fade);
}

/// One weight for each source; they sum to 1.
void Schedule::weigh() noexcept {
  if (options_.blend.is_ensemble_) {
    double sum = 0;
    for (std::size_t i = 0; i < n_source_; ++i) {
      weights_[i] = std::exp(-options_.blend.decay_ * static_cast<double>(i));
      sum = i == 0 ? weights_[i] : sum + weights_[i];
    }
    for (std::size_t i = 0; i < n_source_; ++i) weights_[i] /= sum;
    return;
  }
  weights_[0] = 1;
  for (std::size_t i = 1; i < n_source_; ++i) {
    const Source& each = source(i);
    const double share = std::min(1.0, static_cast<double>(step_ - each.entered + 1) / (each.fade + 1));
    for (std::size_t k = 0; k < i; ++k) weights_[k] *= 1.0 - share;
    weights_[i] = share;
  }
}

Action Schedule::held(std::int64_t tick) noexcept {
  ++counts.held;
  if (options_.late == Late::stop && has_last_) {
    tell(stop_, "late",
         "control: expected an action for period %lld, found no chunk that has one; stop the robot; then reset()",
         static_cast<long long>(tick));
    is_stopped_ = true;
    return {.state = ActionState::stopped, .tick = tick, .problem = &stop_};
  }
  if (options_.late != Late::zero && !has_last_) return {.state = ActionState::none, .tick = tick};
  if (options_.late == Late::zero && options_.limiter != nullptr)
    options_.limiter->still(values_);
  else if (options_.late == Late::zero)
    std::fill(values_.begin(), values_.end(), 0.0f);
  else
    values_ = last_;
  Action action = {.state = ActionState::held, .values = values_, .tick = tick};
  if (options_.limiter != nullptr)
    limit(action);
  else
    last_ = values_, has_last_ = true;
  return action;
}

void Schedule::limit(Action& action) noexcept {
  if (options_.limiter != nullptr) {
    const int n_cut = options_.limiter->step(values_, values_, cut_);
    action.limited = n_cut > 0;
    if (n_cut > 0) action.clamped = cut_;
  } else if (!options_.max_jump.empty() && has_last_ && !action.human) {
    for (std::size_t i = 0; i < values_.size(); ++i) {
      const float most = options_.max_jump[i], cut = std::min(std::max(values_[i], last_[i] - most), last_[i] + most);
      action.limited |= cut != values_[i];
      values_[i] = cut;
    }
  }
  last_ = values_, has_last_ = true;
}

}  // namespace vla::control
