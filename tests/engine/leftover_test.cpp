// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/leftover.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <filesystem>

#include "bundle/gguf_reader.h"
#include "support/editable_bundle.h"
#include "support/golden_case.h"

namespace leftover_test {

using namespace vla;
using namespace vla::test;

namespace {

struct LeftoverCase {
  std::string name;
  GoldenCase golden;
  Leftover leftover;
  Tap chunk;
};

/// What tools/goldens/rtc.py recorded of LeRobot's own classes: `chunk`, or `chunk.<schedule>`.
std::vector<LeftoverCase> leftover_cases() {
  std::vector<LeftoverCase> cases;
  for (const std::string& path : golden_paths()) {
    const std::string file = path + "/leftover.gguf";
    if (!std::filesystem::exists(file)) continue;
    const auto taps = read_taps(file);
    const std::string bytes = read_text(file);
    const auto content = read_gguf(std::as_bytes(std::span(bytes)), file);
    REQUIRE((taps.ok() && content.ok()));
    const int delay = *content->keys.integer("leftover.delay", {0, 100});
    for (const Tap& tap : *taps) {
      if (!tap.path.starts_with("chunk")) continue;
      Leftover leftover{find_tap(*taps, "previous").values, delay, {}, {}};
      if (tap.path != "chunk") {
        leftover.schedule = tap.path.substr(6);
        leftover.max_guidance = *content->keys.number("leftover.max_guidance", {0, 100});
      }
      cases.push_back({file + ", " + tap.path, GoldenCase::read(path), leftover, {"chunk", tap.shape, tap.values}});
    }
  }
  return cases;
}

Result<ActionChunk> act(Engine& engine, const LeftoverCase& c, const std::optional<Leftover>& leftover) {
  return engine.act(c.golden.observation, c.golden.noise, leftover);
}

}  // namespace

TEST_CASE("a chunk that goes on from the rows of another matches the reference, in every family and schedule") {
  const auto cases = leftover_cases();
  CHECK(cases.size() >= 18);
  for (const LeftoverCase& c : cases)
    for (const char* kernels : {"ggml", "float32"}) {
      CAPTURE(c.name);
      CAPTURE(kernels);
      const auto chunk = act(*load_engine(c.golden.bundle(), "chunk", kernels), c, c.leftover);
      REQUIRE_MESSAGE(chunk.ok(), (chunk ? "" : chunk.error().message()));
      const auto difference = compare_taps({c.chunk}, {find_tap(chunk->taps, "chunk")}).front();
      CAPTURE(difference.relative);
      CHECK(difference.within(1e-5));
      CHECK(chunk->normalized == find_tap(chunk->taps, "chunk").values);
    }
}

TEST_CASE("acts with and without a leftover do not change each other") {
  for (const LeftoverCase& c : leftover_cases()) {
    CAPTURE(c.name);
    const auto engine = load_engine(c.golden.bundle());
    const auto alone = act(*engine, c, {}), after = act(*engine, c, c.leftover), again = act(*engine, c, {});
    REQUIRE((alone.ok() && after.ok() && again.ok()));
    CHECK(alone->actions == again->actions);
    CHECK(alone->actions != after->actions);
    CHECK(act(*engine, c, c.leftover)->actions == after->actions);
  }
}

TEST_CASE("a leftover that cannot be meant is refused with what would be right") {
  const std::vector<LeftoverCase> cases = leftover_cases();
  const auto found =
      std::find_if(cases.begin(), cases.end(), [](const auto& c) { return !c.leftover.schedule.empty(); });
  REQUIRE(found != cases.end());
  const auto engine = load_engine(found->golden.bundle());
  const auto refused = [&](auto change) {
    Leftover leftover = found->leftover;
    change(leftover);
    const auto chunk = act(*engine, *found, leftover);
    REQUIRE_FALSE(chunk.ok());
    CHECK(chunk.error().code == Code::bad_observation);
    return chunk.error().message();
  };
  const auto has = [](const std::string& text, const char* part) { return text.find(part) != std::string::npos; };
  CHECK(has(refused([](Leftover& l) { l.rows.clear(); }), "leftover: expected 1 to"));
  CHECK(has(refused([](Leftover& l) { l.rows.pop_back(); }), "rows of"));
  CHECK(has(refused([](Leftover& l) { l.rows.resize(l.rows.size() * 100); }), "leftover: expected 1 to"));
  CHECK(has(refused([](Leftover& l) { l.rows[1] = NAN; }), "leftover[0][1]: expected a finite number"));
  CHECK(has(refused([](Leftover& l) { l.delay = 5; }), "leftover.delay: expected 0 to 4"));
  CHECK(has(refused([](Leftover& l) { l.delay = -1; }), "leftover.delay"));
  CHECK(has(refused([](Leftover& l) { l.schedule = "LINEAR"; }), "zeros, ones, linear or exp, found LINEAR"));
  CHECK(has(refused([](Leftover& l) { l.schedule.clear(); }), "found none"));
  CHECK(has(refused([](Leftover& l) { l.max_guidance.reset(); }), "leftover.max_guidance"));
  CHECK(has(refused([](Leftover& l) { l.max_guidance = 0; }), "a number above 0"));
  CHECK(has(refused([](Leftover& l) { l.max_guidance = NAN; }), "a number above 0"));
}

TEST_CASE("an inpainted policy has no schedule, and its frozen rows stay as they were") {
  for (const LeftoverCase& c : leftover_cases()) {
    if (!c.leftover.schedule.empty()) continue;
    CAPTURE(c.name);
    const auto engine = load_engine(c.golden.bundle());
    const auto chunk = act(*engine, c, c.leftover);
    REQUIRE(chunk.ok());
    const auto frozen = c.leftover.delay * chunk->d_action;
    CHECK(std::equal(chunk->normalized.begin(), chunk->normalized.begin() + frozen, c.leftover.rows.begin()));
    Leftover scheduled = c.leftover;
    scheduled.schedule = "linear";
    CHECK_FALSE(act(*engine, c, scheduled).ok());
  }
}

TEST_CASE("policies that cannot go on from rows say so") {
  for (const char* name : {"gr00t_n1_5/libero", "gr00t_n1_6/libero", "gr00t_n1_7/relative"}) {
    CAPTURE(name);
    const GoldenCase golden = GoldenCase::read(golden_path(name));
    const auto engine = load_engine(golden.bundle());
    CHECK(engine->robot().real_time_chunking().kind == RealTimeChunking::Kind::none);
    const auto chunk = engine->act(golden.observation, golden.noise, Leftover{{0.0f}, 0, {}, {}});
    REQUIRE_FALSE(chunk.ok());
    CHECK(chunk.error().code == Code::unsupported);
  }
}

TEST_CASE("rows in world units are noted, and refused where a state would be") {
  const LeftoverCase c = leftover_cases().front();
  const auto engine = load_engine(c.golden.bundle());
  Leftover far = c.leftover;
  const auto says_far = [](const ActionChunk& chunk, const char* what) {
    return std::any_of(chunk.notes.begin(), chunk.notes.end(),
                       [&](const std::string& note) { return note.starts_with(what); });
  };
  const auto near = act(*engine, c, c.leftover);
  REQUIRE(near.ok());
  CHECK_FALSE(near->out_of_range);
  CHECK_FALSE(says_far(*near, "leftover["));
  far.rows.back() = -100;
  const auto noted = act(*engine, c, far);
  REQUIRE(noted.ok());
  CHECK(noted->out_of_range);
  CHECK(says_far(*noted, "leftover["));
  for (float& x : far.rows) x = 100;
  const auto pulled = act(*engine, c, far);
  REQUIRE(pulled.ok());
  CHECK(says_far(*pulled, "actions["));
  LeftoverCase strict = c;
  strict.golden.observation.reject_out_of_range = true;
  const auto refused = act(*engine, strict, far);
  REQUIRE_FALSE(refused.ok());
  CHECK(refused.error().code == Code::bad_observation);
  CHECK(refused.error().where == "leftover");
}

}  // namespace leftover_test
