// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The precision trap of the vision tower. The reference looks up its position table through floating-point arithmetic
// whose rounding depends on the precision of the pixels and on the release; a runtime that uses another rule than the
// one that the weights were trained with stays within a few per cent everywhere, and is wrong. These tests show the
// failure and its size.
#include <fmt/format.h>

#include <cmath>

#include "modules/vision/position_ids.h"
#include "support/editable_bundle.h"
#include "support/golden_case.h"

#include <doctest/doctest.h>

namespace position_rule_test {

using namespace vla;
using namespace vla::test;

namespace {

constexpr int kSteps[] = {1, 2, 4, 8, 16};
const char* const kRules[] = {"bucketize_float32", "bucketize_bfloat16", "bucketize_shifted"};

std::string case_path() { return golden_path("smolvla/one_view"); }

/// What the reference computes under each rule and number of steps (tools/position_rules.py).
const std::vector<Tap>& reference() {
  static const std::vector<Tap> taps = *read_taps(case_path() + "/position_rules.gguf");
  return taps;
}

const std::vector<float>& reference_chunk(const std::string& rule, int n_step) {
  return find_tap(reference(), fmt::format("{}.steps.{}.chunk", rule, n_step)).values;
}

/// Our chunk, from the golden bundle with its rule and number of steps changed.
std::vector<float> our_chunk(const std::string& rule, int n_step) {
  EditableBundle bundle = EditableBundle::read(case_path() + "/bundle.gguf");
  bundle.set("vision.position_rule", Value(rule));
  bundle.set("solver.steps", Value(std::int64_t{n_step}));
  const GoldenCase golden = GoldenCase::read(case_path());
  const auto chunk = load_engine(bundle.write("rule.gguf"), "chunk", "float32")->act(golden.observation, golden.noise);
  REQUIRE_MESSAGE(chunk.ok(), (chunk ? "" : chunk.error().message()));
  return find_tap(chunk->taps, "chunk").values;
}

/// Largest difference, in units of the largest magnitude of `expected`.
double displacement(const std::vector<float>& got, const std::vector<float>& expected) {
  return compare_taps({{"chunk", {static_cast<std::int64_t>(expected.size())}, expected}},
                      {{"chunk", {static_cast<std::int64_t>(got.size())}, got}})
      .front()
      .relative;
}

}  // namespace

TEST_CASE("position ids equal the reference's under every rule") {
  for (const char* rule : kRules) {
    CAPTURE(rule);
    const std::vector<float>& expected = find_tap(reference(), fmt::format("{}.position_ids", rule)).values;
    const int side = static_cast<int>(std::lround(std::sqrt(static_cast<double>(expected.size()))));
    const auto ids = vision_position_ids(rule, side, side);
    REQUIRE(ids.ok());
    CHECK(std::vector<float>(ids->begin(), ids->end()) == expected);
  }
}

TEST_CASE("the rules read different rows of the table on a 6 x 6 grid") {
  const auto exact = *vision_position_ids("bucketize_float32", 6, 6),
             shifted = *vision_position_ids("bucketize_shifted", 6, 6);
  int n_different = 0;
  for (std::size_t i = 0; i < exact.size(); ++i) n_different += exact[i] != shifted[i];
  CHECK(n_different == 35);  // all but the first patch
}

TEST_CASE("with the rule of the reference the chunk agrees for every number of solver steps") {
  for (const char* rule : kRules)
    for (int n_step : kSteps) {
      CAPTURE(rule);
      CAPTURE(n_step);
      CHECK(displacement(our_chunk(rule, n_step), reference_chunk(rule, n_step)) <= 1e-5);
    }
}

TEST_CASE("with another rule than the reference's the actions are displaced, however many solver steps are taken") {
  for (int n_step : kSteps) {
    CAPTURE(n_step);
    const double matched =
        displacement(our_chunk("bucketize_float32", n_step), reference_chunk("bucketize_float32", n_step));
    const double mismatched =
        displacement(our_chunk("bucketize_shifted", n_step), reference_chunk("bucketize_float32", n_step));
    CHECK(mismatched > 1e-3);  // ten times the parity bar
    CHECK(mismatched > 100 * matched);
  }
}

}  // namespace position_rule_test
