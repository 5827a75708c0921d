// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Asks the policy and keeps the time, like python/vla_cpp/control/loop.py.
#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <thread>

#include "base/clock.h"
#include "control/schedule.h"

namespace vla::control {
namespace {

double monotonic_seconds() { return std::chrono::duration<double>(Clock::now().time_since_epoch()).count(); }

void sleep_seconds(double seconds) { std::this_thread::sleep_for(std::chrono::duration<double>(seconds)); }

/// Whether another observation may succeed after this problem. Any other problem would recur.
bool is_passing(const Problem& problem) {
  for (const char* code : {"busy", "disconnected", "late", "shutting_down", "superseded", "timeout"})
    if (problem.is(code)) return true;
  return false;
}

bool is_finite(std::span<const float> values) {
  return std::all_of(values.begin(), values.end(), [](float value) { return std::isfinite(value); });
}

LoopOptions checked(const Spec& spec, LoopOptions options) {
  if (options.mode == Mode::unset) throw Error("usage", "mode", "sync, async or rtc", "none");
  if (options.on_note == OnNote::unset) throw Error("usage", "on_note", "ignore or raise", "none");
  if (options.rate_hz == 0) options.rate_hz = spec.rate_hz;
  if (options.replan_every == 0) options.replan_every = spec.n_action_steps;
  const std::string missing = "a number, since the bundle does not say";
  if (!(options.rate_hz > 0) || std::isinf(options.rate_hz))
    throw Error("usage", "rate_hz", missing, fmt::format("{:g}", options.rate_hz));
  if (options.replan_every <= 0) throw Error("usage", "replan_every", missing, fmt::format("{}", options.replan_every));
  if (spec.rate_hz > 0 && std::abs(spec.rate_hz - options.rate_hz) > 1e-6 * options.rate_hz &&
      !options.allow_other_rate)
    throw Error("usage", "rate_hz", fmt::format("{:g}, that of {}", spec.rate_hz, spec.bundle),
                fmt::format("{:g}", options.rate_hz),
                "a robot at another rate moves at another speed; allow_other_rate if that is meant");
  if ((options.mode == Mode::rtc) != (options.rtc.overlap != 0))
    throw Error("usage", "rtc", "an overlap with the mode rtc, and only there", fmt::format("{}", options.rtc.overlap));
  if (options.mode == Mode::rtc && spec.real_time_chunking.empty())
    throw Error("unsupported", "mode", "a policy that goes on from rows of the chunk before", spec.bundle);
  if (options.rtc.overlap < 0 || options.rtc.overlap > spec.horizon)
    throw Error("usage", "rtc.overlap", fmt::format("1 to {}, the rows of a chunk", spec.horizon),
                fmt::format("{}", options.rtc.overlap));
  if (options.max_age && !(*options.max_age >= 0))
    throw Error("usage", "max_age", "seconds, 0 or more", fmt::format("{:g}", *options.max_age));
  if (!options.clock) options.clock = monotonic_seconds;
  if (!options.sleep) options.sleep = sleep_seconds;
  return options;
}

std::int64_t age_in_ticks(const LoopOptions& options, const Spec& spec) {
  if (!options.max_age) return options.mode == Mode::sync ? -1 : spec.horizon;
  return static_cast<std::int64_t>(std::floor(*options.max_age * options.rate_hz + 1e-9));
}

}  // namespace

struct ChunkLoop::Impl {
  Policy& policy;
  LoopOptions options;
  std::optional<Limiter> limiter;
  Schedule schedule;
  Observation observation;
  Problem last;
  std::optional<double> start;
  std::int64_t tick = -1, n_missed = 0, n_note = 0;
  bool is_waiting = false;
  std::string driver;  // the person who took over

  Impl(Policy& of, const LoopOptions& given)
      : policy(of),
        options(checked(of.spec(), given)),
        limiter(options.limits ? std::optional<Limiter>(std::in_place, options.limits->of(of.spec()), options.rate_hz)
                               : std::nullopt),
        schedule({.horizon = of.spec().horizon,
                  .d_action = of.spec().d_action,
                  .replan_every = options.replan_every,
                  .blend = options.blend,
                  .late = options.late,
                  .max_age = age_in_ticks(options, of.spec()),
                  .max_jump = options.max_jump,
                  .limiter = limiter ? &*limiter : nullptr}) {}

  /// Returns the current control period. An early caller gets the next one; a late caller has missed some.
  std::int64_t now() {
    const double seconds = options.clock();
    if (!start) start = seconds - static_cast<double>(tick + 1) / options.rate_hz;
    return std::max(tick + 1, static_cast<std::int64_t>(std::floor((seconds - *start) * options.rate_hz + 0.5)));
  }

  void submit(const Observe& observe, std::int64_t at) {
    observe(observation);
    observation.loop = stats();
    Leftover leftover;
    if (options.mode == Mode::rtc) leftover.rows = schedule.leftover(options.rtc.overlap);
    const int n_row = static_cast<int>(leftover.rows.size()) / policy.spec().d_action;
    leftover.delay = std::min(std::max(schedule.delay(), 0), n_row);
    leftover.schedule = options.rtc.schedule, leftover.max_guidance = options.rtc.max_guidance;
    schedule.observe(at);
    policy.submit(observation, n_row > 0 ? &leftover : nullptr);
    is_waiting = true;
  }

  LoopStats stats() const {
    LoopStats stats = schedule.counts;
    stats.missed = n_missed, stats.notes = n_note, stats.delay = schedule.delay(), stats.is_driven = !driver.empty();
    return stats;
  }

  /// Returns false if `last` is a problem that would recur with another observation.
  bool collect(std::int64_t at) {
    const Answer* answer = is_waiting ? policy.poll() : nullptr;
    if (answer == nullptr) return true;
    is_waiting = false;
    last = answer->problem;
    if (last.code[0] == '\0') {
      n_note += answer->n_note;
      if (answer->n_note > 0 && options.on_note == OnNote::raise)
        tell(last, "noted", "chunk: expected no notes, found %s", answer->note.message);
      else
        return schedule.receive(*answer, at, last);
    }
    schedule.fail();
    return is_passing(last);
  }

  Action step(const Observe& observe, std::span<const float> human) {
    std::int64_t at = now();
    const auto failed = [&] { return Action{.state = ActionState::failed, .tick = at, .problem = &last}; };
    if (!human.empty() &&
        (driver.empty() || human.size() != static_cast<std::size_t>(policy.spec().d_action) || !is_finite(human))) {
      tell(last, driver.empty() ? "usage" : "bad_action", "human: expected %d finite numbers, of a person who drives",
           policy.spec().d_action);
      return failed();
    }
    if (!collect(at)) return failed();
    if (schedule.wants(at)) {
      submit(observe, at);
      if (options.mode == Mode::sync) {
        policy.wait();
        at = now();
        if (!collect(at)) return failed();
      }
    }
    n_missed += at - tick - 1;
    tick = at;
    return !driver.empty() && human.empty() ? schedule.hold(at) : schedule.next(at, human);
  }
};

ChunkLoop::ChunkLoop(Policy& policy, LoopOptions options) : impl_(std::make_unique<Impl>(policy, options)) {}
ChunkLoop::~ChunkLoop() { impl_->policy.abandon(); }

void ChunkLoop::start_at(std::span<const double> values) {
  if (!impl_->limiter) throw Error("usage", "start_at", "a loop with limits", "none");
  impl_->limiter->rest_at(values);
}

void ChunkLoop::begin(const Observe& observe) {
  Impl& loop = *impl_;
  const std::int64_t at = loop.now();
  if (loop.schedule.wants(at)) loop.submit(observe, at);
  loop.policy.wait();
  loop.start.reset();
  loop.collect(loop.now());
  if (loop.last.code[0] != '\0') throw Error(loop.last.code, "begin", "", loop.last.message);
}

Action ChunkLoop::step(const Observe& observe, std::span<const float> human) noexcept {
  return impl_->step(observe, human);
}

void ChunkLoop::take_over(const std::string& who) {
  if (who.empty() || !impl_->driver.empty())
    throw Error("usage", "take_over", "nobody who drives, and a name", impl_->driver);
  impl_->driver = who;
}

void ChunkLoop::give_back(const std::string& who) {
  Impl& loop = *impl_;
  if (loop.driver.empty() || loop.driver != who)
    throw Error("usage", "give_back", who + ", who drives", loop.driver.empty() ? "nobody" : loop.driver);
  loop.driver.clear();
  loop.policy.abandon();
  loop.is_waiting = false;
  loop.schedule.forget_chunks();
}

void ChunkLoop::pace() noexcept {
  const Impl& loop = *impl_;
  if (loop.start)
    loop.options.sleep(
        std::max(0.0, *loop.start + static_cast<double>(loop.tick + 1) / loop.options.rate_hz - loop.options.clock()));
}

bool ChunkLoop::is_reading() const noexcept { return impl_->policy.is_reading(); }
const Problem& ChunkLoop::last_problem() const noexcept { return impl_->last; }
LoopStats ChunkLoop::stats() const noexcept { return impl_->stats(); }
double ChunkLoop::rate_hz() const noexcept { return impl_->options.rate_hz; }

void ChunkLoop::reset() noexcept {
  Impl& loop = *impl_;
  loop.policy.abandon();
  loop.is_waiting = false;
  loop.start.reset();
  loop.tick = -1, loop.n_missed = loop.n_note = 0;
  loop.last = {};
  loop.driver.clear();
  loop.schedule.reset();
}

}  // namespace vla::control
