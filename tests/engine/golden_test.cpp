// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Every golden case end to end, block by block, against what the reference computed (tools/goldens/recorder.py).
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <regex>

#include "kernels/kernel_set.h"
#include "support/editable_bundle.h"
#include "support/golden_case.h"

namespace golden_test {

using namespace vla;
using namespace vla::test;

namespace {

// Both sides compute in float32 and differ in the order of their sums only: a few parts in 10^7 for each block, growing
// with depth. A tenth of the bar that a released bundle must meet leaves room for other machines' vector widths.
constexpr double kTolerance = 1e-5;

/// What the golden writer stores beside taps: the same chunk in PyTorch's bf16, and the vision ids.
bool is_no_tap(const std::string& path) { return path == "chunk.bf16" || path.starts_with("position_ids"); }

double max_difference(const std::vector<float>& a, const std::vector<float>& b) {
  double largest = 0;
  REQUIRE(a.size() == b.size());
  for (std::size_t i = 0; i < a.size(); ++i) largest = std::max(largest, std::abs(double{a[i]} - b[i]));
  return largest;
}

double rms_difference(const std::vector<float>& a, const std::vector<float>& b) {
  double squares = 0;
  REQUIRE(a.size() == b.size());
  for (std::size_t i = 0; i < a.size(); ++i) squares += std::pow(double{a[i]} - b[i], 2);
  return std::sqrt(squares / static_cast<double>(a.size()));
}

}  // namespace

TEST_CASE("there are golden cases to check") { CHECK(golden_paths().size() >= 3); }

namespace {

/// Whether a tap ends a block or a part of the network: nothing within blocks is recorded where such taps are, so that
/// whatever can be fused is.
bool is_boundary(const std::string& path) {
  static const std::regex boundary(R"(.*\.blk\.\d+|step\.\d+\.x|chunk|actions)");
  return std::regex_match(path, boundary);
}

[[maybe_unused]] void check_taps(const std::string& kernels, bool boundaries) {
  for (const std::string& path : some_of(golden_paths())) {
    CAPTURE(path);
    const GoldenCase golden = GoldenCase::read(path);
    std::vector<Tap> taps = golden.expected();
    std::erase_if(taps, [&](const Tap& tap) { return is_no_tap(tap.path) || (boundaries && !is_boundary(tap.path)); });
    std::string pattern = boundaries ? "" : "*";
    for (const Tap& tap : taps) pattern += boundaries ? tap.path + "," : "";
    REQUIRE(taps.size() > 3);
    const auto chunk = load_engine(golden.bundle(), pattern, kernels)->act(golden.observation, golden.noise);
    REQUIRE_MESSAGE(chunk.ok(), (chunk ? "" : chunk.error().message()));
    for (const Tap& expected : taps) {
      const auto difference = compare_taps({expected}, {find_tap(chunk->taps, expected.path)}).front();
      CAPTURE(expected.path);
      CAPTURE(difference.relative);
      CHECK(difference.within(kTolerance));
    }
  }
}

/// The chunk alone is recorded, so that everything that can be fused is. Without a name the kernels are those that a
/// user gets.
void check_chunk(const std::string& kernels) {
  for (const std::string& path : some_of(golden_paths())) {
    CAPTURE(path);
    const GoldenCase golden = GoldenCase::read(path);
    const auto expected = golden.expected();
    const auto engine = load_engine(golden.bundle(), "chunk", kernels);
    const auto chunk = engine->act(golden.observation, golden.noise);
    REQUIRE(chunk.ok());
    const std::vector<float>& reference = find_tap(expected, "chunk").values;
    const std::vector<float>&ours = find_tap(chunk->taps, "chunk").values,
          &bf16 = find_tap(expected, "chunk.bf16").values;
    CHECK(rms_difference(ours, reference) <= rms_difference(bf16, reference));
    CHECK(max_difference(ours, reference) <= max_difference(bf16, reference));
    if (engine->device().precision() == Precision::f32)
      CHECK(compare_taps({find_tap(expected, "chunk")}, {find_tap(chunk->taps, "chunk")}).front().within(kTolerance));
  }
}

bool lacks(const KernelSet& set) {
  return std::find(usable_kernels().begin(), usable_kernels().end(), set) == usable_kernels().end();
}

}  // namespace

#ifndef VLA_EMULATED_MACHINE  // these kernels are the same in the other programs
#define VLA_EVERY_TAP " kernels: every tap of every golden case, from pixels to actions, matches the reference"
TEST_CASE("ggml" VLA_EVERY_TAP) { check_taps("ggml", false); }
TEST_CASE("portable" VLA_EVERY_TAP) { check_taps("portable", false); }
TEST_CASE("neon" VLA_EVERY_TAP* doctest::skip(lacks(kernel_set::neon))) { check_taps("neon", false); }
TEST_CASE("avx2" VLA_EVERY_TAP* doctest::skip(lacks(kernel_set::avx2))) { check_taps("avx2", false); }
TEST_CASE("avx512" VLA_EVERY_TAP* doctest::skip(lacks(kernel_set::avx512))) { check_taps("avx512", false); }

#define VLA_BOUNDARIES " kernels: blocks whose operations are fused match the reference where they end"
TEST_CASE("portable" VLA_BOUNDARIES) { check_taps("portable", true); }
TEST_CASE("neon" VLA_BOUNDARIES* doctest::skip(lacks(kernel_set::neon))) { check_taps("neon", true); }
TEST_CASE("avx2" VLA_BOUNDARIES* doctest::skip(lacks(kernel_set::avx2))) { check_taps("avx2", true); }
TEST_CASE("avx512" VLA_BOUNDARIES* doctest::skip(lacks(kernel_set::avx512))) { check_taps("avx512", true); }
#endif

// Kernels of bf16 round activations as PyTorch's bf16 does: its error is what is allowed. PyTorch keeps the
// projections of state and actions in float32 and rounds every result between two operations, we do neither.
#define VLA_CHUNK \
  " kernels: with the same bf16 weights the chunk is nearer to the float32 reference than PyTorch's bf16 is"
TEST_CASE("amx" VLA_CHUNK* doctest::skip(lacks(kernel_set::amx))) { check_chunk("amx"); }
#ifndef VLA_EMULATED_MACHINE
TEST_CASE("default" VLA_CHUNK) { check_chunk(""); }
TEST_CASE("ggml" VLA_CHUNK) { check_chunk("ggml"); }
TEST_CASE("portable" VLA_CHUNK) { check_chunk("portable"); }
TEST_CASE("neon" VLA_CHUNK* doctest::skip(lacks(kernel_set::neon))) { check_chunk("neon"); }
TEST_CASE("neon_bf16" VLA_CHUNK* doctest::skip(lacks(kernel_set::neon_bf16))) { check_chunk("neon_bf16"); }
TEST_CASE("avx2" VLA_CHUNK* doctest::skip(lacks(kernel_set::avx2))) { check_chunk("avx2"); }
TEST_CASE("avx512" VLA_CHUNK* doctest::skip(lacks(kernel_set::avx512))) { check_chunk("avx512"); }
TEST_CASE("avx512_bf16" VLA_CHUNK* doctest::skip(lacks(kernel_set::avx512_bf16))) { check_chunk("avx512_bf16"); }
#endif

TEST_CASE("taps do not change the answer, and without a pattern nothing is recorded") {
  const GoldenCase golden = GoldenCase::read(golden_paths().front());
  const auto plain = load_engine(golden.bundle(), "", "float32")->act(golden.observation, golden.noise);
  const auto tapped = load_engine(golden.bundle(), "*", "float32")->act(golden.observation, golden.noise);
  REQUIRE(plain.ok());
  REQUIRE(tapped.ok());
  CHECK(plain->taps.empty());
  CHECK(max_difference(plain->actions, tapped->actions) <= 1e-5);
}

namespace {

/// Acts with taps that are kept, and with taps that are seen.
[[maybe_unused]] void check_seen(const std::string& path, const std::string& kernels) {
  CAPTURE(path);
  CAPTURE(kernels);
  const GoldenCase golden = GoldenCase::read(path);
  const auto keeping = load_engine(golden.bundle(), "*", kernels);
  const auto kept = keeping->act(golden.observation, golden.noise);
  REQUIRE(kept.ok());
  std::vector<Tap> seen;
  const auto see = [&](const std::string& tap, auto shape, auto values) {
    seen.push_back({tap, {shape.begin(), shape.end()}, {values.begin(), values.end()}});
  };
  const auto engine =
      Engine::load(golden.bundle(), {.n_thread = 2, .kernels = kernels, .tap_pattern = "*", .see_tap = see});
  REQUIRE(engine.ok());
  seen.clear();  // of what is computed at load, which no act keeps
  const auto chunk = (*engine)->act(golden.observation, golden.noise);
  REQUIRE(chunk.ok());
  CHECK(chunk->taps.empty());
  REQUIRE(seen.size() == kept->taps.size());
  for (const Tap& tap : kept->taps) CHECK_MESSAGE(find_tap(seen, tap.path).values == tap.values, tap.path);
  if (kernels == "float32") CHECK((*engine)->memory().working < keeping->memory().working);
}

}  // namespace

#ifndef VLA_EMULATED_MACHINE
TEST_CASE("a visitor sees the values that taps keep without it, in less memory") {
  for (const std::string& path : some_of(golden_paths())) check_seen(path, "float32");
  check_seen(golden_paths().front(), "ggml");
}
#endif

TEST_CASE("a second request, and one after a request of another shape, give the same bytes as the first") {
  for (const std::string& path : some_of(golden_paths())) {
    CAPTURE(path);
    const GoldenCase golden = GoldenCase::read(path);
    const auto engine = load_engine(golden.bundle());
    const auto first = engine->act(golden.observation, golden.noise);
    REQUIRE(first.ok());
    Observation shorter = golden.observation;
    shorter.text = "go";
    const auto other = engine->act(shorter, golden.noise);
    if (!other) CHECK(other.error().code == Code::bad_action);  // tokens that must begin in one way
    CHECK(engine->act(golden.observation, golden.noise)->actions == first->actions);
  }
}

}  // namespace golden_test
