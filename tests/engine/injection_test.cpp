// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Values that take the place of computed ones: every family goes on from them, and BitVLA's parts are held to the
// reference each by itself, since a code that flips anywhere before would move all that follows.
#include <doctest/doctest.h>

#include <algorithm>
#include <regex>

#include "kernels/kernel_set.h"
#include "support/editable_bundle.h"
#include "support/golden_case.h"

namespace injection_test {

using namespace vla;
using namespace vla::test;

namespace {

ActionChunk act(const GoldenCase& golden, const std::string& taps, const std::string& kernels,
                const std::vector<Tap>& inject) {
  auto chunk = load_engine(golden.bundle(), taps, kernels, inject)->act(golden.observation, golden.noise);
  REQUIRE_MESSAGE(chunk.ok(), (chunk ? "" : chunk.error().message()));
  return std::move(*chunk);
}

std::string refusal(const GoldenCase& golden, const std::vector<Tap>& inject) {
  const auto chunk = load_engine(golden.bundle(), "", "float32", inject)->act(golden.observation, golden.noise);
  REQUIRE(!chunk.ok());
  CHECK(chunk.error().code == Code::bad_observation);
  return chunk.error().message();
}

bool contains(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

/// Of BitVLA, what the module of this tap reads: the name of a tap, or nothing where that is not recorded.
std::string input_of(const std::string& tap, const std::vector<Tap>& all) {
  constexpr std::pair<const char*, const char*> kRules[] = {
      {R"((.*)\.attn_[qkv])", "$1.attn_norm"},
      {R"((lm\..*)\.attn_out)", "$1.attn_sub_norm"},
      {R"((.*)\.ffn_(up|gate))", "$1.ffn_norm"},
      {R"((lm\..*)\.ffn_down)", "$1.ffn_sub_norm"},
      {R"(lm\.blk\.0(\.attn_norm)?)", "prefix"},
      {R"(vision\.patch_embed)", "pixels"},
      {R"(state_out)", "state"},
      {R"(step\.0\.head\.in)", "step.0.head.in_norm"},
      {R"(step\.0\.head\.blk\.0)", "step.0.head.in"},
      {R"(step\.0\.head\.out)", "step.0.head.out_norm"},
  };
  std::string input;
  for (const auto& [pattern, replacement] : kRules)
    if (std::smatch match; std::regex_match(tap, match, std::regex(pattern))) input = match.format(replacement);
  std::smatch block;
  if (std::regex_match(tap, block, std::regex(R"((.*\.blk\.)(\d+))")) && block[2] != "0")
    input = block[1].str() + std::to_string(std::stoi(block[2]) - 1);
  // Behind a tower comes what reads its last block.
  for (const auto& [name, tower] :
       {std::pair("connector_down", "vision"), {"lm.norm", "lm"}, {"step.0.head.out_norm", "step.0.head"}})
    for (int i = 0; tap == name && i < 100; ++i) {
      const std::string block_name = std::string(tower) + ".blk." + std::to_string(i);
      if (std::any_of(all.begin(), all.end(), [&](const Tap& other) { return other.path == block_name; }))
        input = block_name;
    }
  return input;
}

/// Ternary products give the reference's sums, so that only what scales them is rounded.
double tolerance_of(const std::string& tap) {
  return std::regex_match(tap, std::regex(R"(.*\.(attn_[qkv]|ffn_up|ffn_gate))")) ? 1e-6 : 1e-5;
}

void check_parts(const std::string& kernels) {
  int n_case = 0, n_part = 0;
  for (const std::string& path : golden_paths()) {
    if (!contains(path, "/bitvla/")) continue;
    CAPTURE(path);
    ++n_case;
    const GoldenCase golden = GoldenCase::read(path);
    const std::vector<Tap> all = golden.expected();
    for (const Tap& expected : all) {
      const std::string input = input_of(expected.path, all);
      if (input.empty()) continue;
      CAPTURE(expected.path);
      const ActionChunk chunk = act(golden, expected.path, kernels, {find_tap(all, input)});
      const TapDifference difference = compare_taps({expected}, chunk.taps).front();
      CAPTURE(difference.relative);
      CHECK(difference.within(tolerance_of(expected.path)));
      ++n_part;
    }
  }
  CHECK(n_case >= 3);
  CHECK(n_part >= 20 * n_case);
}

bool lacks(const KernelSet& set) {
  return std::find(usable_kernels().begin(), usable_kernels().end(), set) == usable_kernels().end();
}

}  // namespace

#define VLA_PARTS " kernels: with the reference's own inputs every part of BitVLA gives the reference's output"
TEST_CASE("ggml" VLA_PARTS) { check_parts("ggml"); }
TEST_CASE("portable" VLA_PARTS) { check_parts("portable"); }
TEST_CASE("avx2" VLA_PARTS* doctest::skip(lacks(kernel_set::avx2))) { check_parts("avx2"); }
TEST_CASE("avx512" VLA_PARTS* doctest::skip(lacks(kernel_set::avx512))) { check_parts("avx512"); }

TEST_CASE("a chunk follows from injected values, in every family, on all kernels") {
  for (const std::string& path : some_of(golden_paths())) {
    CAPTURE(path);
    const GoldenCase golden = GoldenCase::read(path);
    const std::vector<Tap> all = golden.expected();
    const bool decodes = std::any_of(all.begin(), all.end(), [](const Tap& tap) { return tap.path == "tokens_out"; });
    if (decodes) continue;  // other values may give the same tokens, or none of actions
    const auto block = std::find_if(all.begin(), all.end(), [](const Tap& tap) {
      return contains(tap.path, ".blk.0") && !tap.path.starts_with("step.");
    });
    Tap same = block == all.end() ? find_tap(all, "prefix") : *block, other = same;
    CAPTURE(same.path);
    for (std::size_t i = 0; i < other.values.size(); ++i)
      other.values[i] = -0.5f * other.values[i] + 0.1f * static_cast<float>(i % 7);
    for (const char* kernels : {"ggml", "float32"}) {
      const ActionChunk as_before = act(golden, "chunk", kernels, {same});
      CHECK(compare_taps({find_tap(all, "chunk")}, as_before.taps).front().within(1e-5));
      const ActionChunk changed = act(golden, "chunk," + same.path, kernels, {other});
      CHECK(!compare_taps({find_tap(all, "chunk")}, changed.taps).front().within(1e-5));
      CHECK(find_tap(changed.taps, same.path).values == other.values);
      CHECK(std::count(changed.notes.begin(), changed.notes.end(), same.path + " was injected, not computed") == 1);
    }
  }
}

TEST_CASE("values of a step are injected step by step") {
  int n_case = 0;
  for (const std::string& path : some_of(golden_paths())) {
    CAPTURE(path);
    const GoldenCase golden = GoldenCase::read(path);
    const std::vector<Tap> all = golden.expected();
    std::vector<Tap> x;
    for (int k = 0; std::any_of(all.begin(), all.end(),
                                [&](const Tap& tap) { return tap.path == "step." + std::to_string(k) + ".x"; });
         ++k) {
      x.push_back(find_tap(all, "step." + std::to_string(k) + ".x"));
      for (float& value : x.back().values) value += static_cast<float>(k + 1);
    }
    n_case += x.empty() ? 0 : 1;
    if (x.empty()) continue;
    const ActionChunk chunk = act(golden, "step.*.x", "float32", x);
    for (const Tap& tap : x) CHECK(find_tap(chunk.taps, tap.path).values == tap.values);
    if (x.size() > 1)
      CHECK(contains(refusal(golden, {x.front()}), "values of all " + std::to_string(x.size()) + " steps"));
  }
  CHECK(n_case >= 5);
}

TEST_CASE("what cannot be injected is refused by name") {
  const GoldenCase golden = GoldenCase::read(golden_paths().front());
  const std::vector<Tap> all = golden.expected();
  const auto found = std::find_if(all.begin(), all.end(), [](const Tap& tap) { return contains(tap.path, ".blk.0"); });
  REQUIRE(found != all.end());
  Tap tap = *found;
  tap.shape.front() += 1, tap.values.resize(tap.values.size() + 1000);
  CHECK(contains(refusal(golden, {tap}), "injected " + tap.path + ": expected shape ["));
  tap.path += "x";
  CHECK(contains(refusal(golden, {tap}), "the nearest are " + found->path));
  CHECK(contains(refusal(golden, {{"pixels", {3}, {1, 2, 3}}}), "injected pixels"));
  const auto engine = Engine::load(golden.bundle(), {.n_thread = 1, .inject = {find_tap(all, "chunk")}});
  REQUIRE(!engine.ok());
  CHECK(contains(engine.error().message(), "injected chunk"));
}

}  // namespace injection_test
