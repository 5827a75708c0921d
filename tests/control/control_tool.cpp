// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Runs the scenarios of tests/control/cpp_test.py and tests/client/cpp_client_test.py through the classes of
// vla/control.h: one JSON document a line in, one line out. Floats are printed as their bits.
#include <sched.h>
#include <sys/mman.h>
#include <time.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <iterator>
#include <new>
#include <nlohmann/json.hpp>
#include <string>

#include "vla/control.h"

using namespace vla::control;
using Json = nlohmann::json;

/// Allocations of this thread.
static thread_local std::int64_t n_allocation = 0;
[[gnu::noinline]] void* operator new(std::size_t size) {
  ++n_allocation;
  if (void* memory = std::malloc(size)) return memory;
  throw std::bad_alloc();
}
[[gnu::noinline]] void operator delete(void* memory) noexcept { std::free(memory); }
[[gnu::noinline]] void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }

namespace {

std::vector<float> floats(const Json& rows) {
  std::vector<float> all;
  for (const Json& each : rows)
    for (const Json& value : each) all.push_back(value.get<float>());
  return all;
}

Json bits(std::span<const float> values) {
  Json all = Json::array();
  for (const float value : values) all.push_back(std::bit_cast<std::uint32_t>(value));
  return all;
}

/// Answers as the scenario says, so many seconds after an observation, by a clock of its own.
class ScriptedPolicy : public Policy {
 public:
  explicit ScriptedPolicy(const Json& scenario) : answers_(scenario["answers"]) {
    const Json& given = scenario["spec"];
    spec_ = {.bundle = "scripted",
             .action_names = given["names"],
             .action_units = given["units"],
             .horizon = given["horizon"],
             .d_action = given["d_action"],
             .rate_hz = given["rate_hz"],
             .n_action_steps = given["n_action_steps"],
             .real_time_chunking = given["rtc"]};
  }

  const Spec& spec() const override { return spec_; }
  void submit(const Observation& observation, const Leftover* leftover) noexcept override {
    const Json& script = answers_[n_asked_++ % answers_.size()];
    due_ = now + script["seconds"].get<double>();
    answer_ = {.horizon = spec_.horizon, .d_action = spec_.d_action};
    rows_ = floats(script["rows"]), normalized_ = floats(script["normalized"]);
    answer_.rows = rows_, answer_.normalized = normalized_;
    answer_.n_note = script["notes"];
    const std::string code = script["error"];
    code.copy(answer_.problem.code, sizeof answer_.problem.code - 1);
    const LoopStats& loop = *observation.loop;
    asked.push_back({{"loop",
                      {{"driver", loop.is_driven ? "PERSON" : "POLICY"},
                       {"actions", loop.actions},
                       {"human", loop.human},
                       {"held", loop.held},
                       {"missed", loop.missed},
                       {"limited", loop.limited},
                       {"refused", loop.refused}}},
                     {"leftover", nullptr}});
    if (leftover != nullptr)
      asked.back()["leftover"] = {
          {"rows", bits(leftover->rows)}, {"delay", leftover->delay}, {"schedule", leftover->schedule}};
    is_under_way_ = true;
  }
  bool is_reading() const noexcept override { return false; }
  const Answer* poll() noexcept override { return is_under_way_ && now >= due_ ? &answer_ : nullptr; }
  void wait() noexcept override {
    if (is_under_way_) now = std::max(now, due_);
  }
  void abandon() noexcept override { is_under_way_ = false; }

  double now = 0;
  Json asked = Json::array();

 private:
  Json answers_;
  Spec spec_;
  Answer answer_;
  std::vector<float> rows_, normalized_;
  double due_ = 0;
  std::size_t n_asked_ = 0;
  bool is_under_way_ = false;
};

Json shown(const Action& action) {
  constexpr const char* kStates[] = {"command", "held", "none", "stopped", "failed"};
  Json clamped = Json::array();
  for (std::size_t i = 0; i < action.clamped.size(); ++i)
    if (action.clamped[i]) clamped.push_back(i);
  Json json = {{"state", kStates[static_cast<int>(action.state)]}, {"values", bits(action.values)}};
  if (action.problem != nullptr) return {{"state", json["state"]}, {"code", action.problem->code}};
  json.update({{"human", action.human}, {"policy", bits(action.policy)}});
  json.update({{"tick", action.tick}, {"age", action.age}, {"limited", action.limited}, {"clamped", clamped}});
  return json;
}

Json run_loop(const Json& scenario) {
  ScriptedPolicy policy(scenario);
  const Json& given = scenario["options"];
  const std::string mode = given["mode"], late = given["late"], blend = given["blend"];
  LoopOptions options = {.rate_hz = given["rate_hz"], .replan_every = given["replan_every"]};
  options.mode = mode == "sync" ? Mode::sync : mode == "async" ? Mode::async : Mode::rtc;
  options.blend = blend == "linear" ? Blend::linear(given["fade_steps"]) : Blend::ensemble(given["decay"]);
  options.late = late == "hold" ? Late::hold : late == "zero" ? Late::zero : Late::stop;
  options.on_note = given["on_note"] == "raise" ? OnNote::raise : OnNote::ignore;
  if (mode == "rtc") options.rtc = {.overlap = given["overlap"], .schedule = "exp", .max_guidance = 5};
  if (!given["max_age"].is_null()) options.max_age = given["max_age"].get<double>();
  if (!given["max_jump"].is_null()) options.max_jump = given["max_jump"].get<std::vector<float>>();
  if (!given["limits"].is_null()) options.limits = Limits::parse(given["limits"].dump());
  options.clock = [&] { return policy.now; };
  ChunkLoop loop(policy, options);
  Json actions = Json::array();
  const auto start = scenario["start"].get<std::vector<double>>();
  if (options.limits) loop.start_at(start);
  for (const Json& time : scenario["times"]) {
    if (time.is_null()) {
      loop.reset();
      if (options.limits) loop.start_at(start);
      continue;
    }
    if (time.is_string()) {
      time == "take over" ? loop.take_over("operator") : loop.give_back("operator");
      continue;
    }
    policy.now = std::max(policy.now, time["at"].get<double>());
    actions.push_back(shown(loop.step([](Observation&) {}, time["human"].get<std::vector<float>>())));
  }
  const LoopStats stats = loop.stats();
  return {{"actions", actions},
          {"asked", policy.asked},
          {"stats",
           {stats.actions, stats.held, stats.chunks, stats.stale, stats.failed, stats.limited, stats.refused,
            stats.missed, stats.notes, stats.human, stats.delay}}};
}

Json run_limiter(const Json& scenario) {
  Limiter limiter(Limits::parse(scenario["limits"].dump()), scenario["rate_hz"]);
  limiter.rest_at(scenario["start"].get<std::vector<double>>());
  Json commands = Json::array();
  for (const Json& row : scenario["wanted"]) {
    const auto wanted = row.get<std::vector<float>>();
    std::vector<float> out(wanted.size());
    std::vector<std::uint8_t> cut(wanted.size());
    limiter.step(wanted, out, cut);
    commands.push_back(bits(out));
  }
  int first = 0;
  const int n_broken = limiter.breaks(floats(scenario["wanted"]), first);
  return {{"commands", commands}, {"broken", {n_broken, first}}};
}

Json run_interpolator(const Json& scenario) {
  std::vector<Kind> kinds;
  for (const Json& kind : scenario["kinds"])
    kinds.push_back(kind == "position"     ? Kind::position
                    : kind == "velocity"   ? Kind::velocity
                    : kind == "difference" ? Kind::difference
                                           : Kind::gripper);
  const std::string method = scenario["method"];
  Interpolator between(kinds,
                       method == "linear"  ? Method::linear
                       : method == "cubic" ? Method::cubic
                                           : Method::minimum_jerk,
                       20);
  between.start_at(scenario["start"].get<std::vector<double>>());
  Json commands = Json::array();
  for (const Json& row : scenario["rows"]) {
    between.to(row.get<std::vector<float>>());
    for (const Json& share : scenario["shares"]) {
      std::vector<float> out(kinds.size());
      if (!between.at(share, out)) throw Error("usage", "shares", "rising ones", share.dump());
      commands.push_back(out);
    }
  }
  return commands;
}

/// What a scenario sends: frames from files, states and a sentence.
struct Sent {
  explicit Sent(const Json& scenario) {
    for (const Json& frame : scenario["frames"]) {
      std::ifstream file(frame["file"].get<std::string>(), std::ios::binary);
      files.emplace_back(std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>());
    }
    for (std::size_t i = 0; i < files.size(); ++i) {
      const Json& frame = scenario["frames"][i];
      observation.frames.push_back(
          {frame["view"], frame["width"], frame["height"], std::as_bytes(std::span(files[i]))});
    }
    for (const Json& view : scenario["absent"]) observation.frames.push_back({.view = view});
    for (const auto& [name, values] : scenario["states"].items()) observation.states.push_back({name, values});
    observation.text = scenario["text"].get<std::string>();
  }
  std::vector<std::string> files;
  Observation observation;
};

ClientOptions client_options(const Json& scenario) {
  ClientOptions options = {.timeout = scenario["timeout"]};
  options.policy = scenario.value("policy", ""), options.embodiment = scenario.value("embodiment", "");
  options.server_key = scenario.value("server_key", ""), options.secret_key = scenario.value("secret_key", "");
  return options;
}

/// One act for each seed.
Json run_client(const Json& scenario) {
  Client client(scenario["address"], client_options(scenario));
  Sent sent(scenario);
  Json answers = Json::array();
  for (const Json& seed : scenario["seeds"]) {
    sent.observation.seed = seed.get<std::uint64_t>();
    client.submit(sent.observation, nullptr);
    client.wait();
    const Answer& answer = *client.poll();
    if (answer.problem.code[0] != '\0')
      answers.push_back({{"code", answer.problem.code}, {"message", answer.problem.message}});
    else
      answers.push_back({{"rows", bits(answer.rows)}, {"notes", answer.n_note}, {"note", answer.note.message}});
  }
  return {{"answers", answers}, {"names", client.spec().action_names}, {"horizon", client.spec().horizon}};
}

double seconds_of(clockid_t clock) {
  timespec now = {};
  clock_gettime(clock, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

/// Microseconds: the middle, the share of 9,999 in 10,000 and the most.
Json microseconds(std::vector<double> took) {
  std::sort(took.begin(), took.end());
  return {1e6 * took[took.size() / 2], 1e6 * took[took.size() - 1 - took.size() / 10000], 1e6 * took.back()};
}

/// A loop at its rate for some seconds: states, commands, and what a step took by the clock and of its thread's time.
Json run_drive(const Json& scenario) {
  if (scenario.value("real_time", false)) {
    const sched_param priority = {.sched_priority = 20};
    if (sched_setscheduler(0, SCHED_FIFO, &priority) != 0 || mlockall(MCL_CURRENT | MCL_FUTURE) != 0)
      throw Error("usage", "real_time", "the right to it", "none");
  }
  Client client(scenario["address"], client_options(scenario));
  const Sent sent(scenario);
  LoopOptions options = {.rate_hz = scenario["rate_hz"], .replan_every = scenario["replan_every"], .mode = Mode::async};
  options.blend = Blend::linear(4), options.late = Late::hold, options.on_note = OnNote::ignore,
  options.allow_other_rate = true;
  if (scenario.contains("limits")) options.limits = Limits::parse(scenario["limits"].dump());
  ChunkLoop loop(client, options);
  if (options.limits) loop.start_at(scenario["start"].get<std::vector<double>>());
  const ChunkLoop::Observe observe = [&](Observation& observation) { observation = sent.observation; };
  loop.begin(observe);
  const auto n_step = static_cast<std::size_t>(scenario["seconds"].get<double>() * loop.rate_hz());
  std::vector<double> took(n_step), own(n_step);
  std::vector<int> states(n_step);
  std::vector<float> commands;
  commands.reserve(n_step * static_cast<std::size_t>(client.spec().d_action));
  loop.step(observe), loop.pace();  // the first fills vectors of the observation
  const std::int64_t before = n_allocation;
  for (std::size_t i = 0; i < n_step; ++i) {
    const double begun = seconds_of(CLOCK_MONOTONIC), begun_own = seconds_of(CLOCK_THREAD_CPUTIME_ID);
    const Action action = loop.step(observe);
    own[i] = seconds_of(CLOCK_THREAD_CPUTIME_ID) - begun_own;
    took[i] = seconds_of(CLOCK_MONOTONIC) - begun;
    states[i] = static_cast<int>(action.state);
    commands.insert(commands.end(), action.values.begin(), action.values.end());
    loop.pace();
  }
  const std::int64_t n_new = n_allocation - before;
  const LoopStats stats = loop.stats();
  return {{"states", states},
          {"commands", bits(commands)},
          {"allocations", n_new},
          {"clock_us", microseconds(took)},
          {"own_us", microseconds(own)},
          {"missed", stats.missed},
          {"chunks", stats.chunks},
          {"failed", stats.failed}};
}

Json run_limits(const Json& scenario) {
  Limits::parse(scenario["text"].get<std::string>());
  return "read";
}

}  // namespace

int main() {
  for (std::string line; std::getline(std::cin, line);) {
    const Json scenario = Json::parse(line);
    const std::string kind = scenario["kind"];
    Json result;
    try {
      result = kind == "loop"           ? run_loop(scenario)
               : kind == "limiter"      ? run_limiter(scenario)
               : kind == "interpolator" ? run_interpolator(scenario)
               : kind == "client"       ? run_client(scenario)
               : kind == "drive"        ? run_drive(scenario)
                                        : run_limits(scenario);
    } catch (const Error& error) {
      result = {{"error", error.what()}, {"code", error.code}};
    }
    std::cout << result.dump() << std::endl;
  }
  return 0;
}
