// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Bundles of every architecture with something odd in them load and act, or are refused: the check of a fuzz target,
// with a seed instead of a fuzzer.
#include <doctest/doctest.h>

#include "fuzz/act_target.h"
#include "fuzz/mutant.h"
#include "support/editable_bundle.h"
#include "support/joint_bundle.h"

namespace mutated_test {

using namespace vla;
using namespace vla::test;

namespace {

constexpr int kRounds = 25;  // for each architecture

}  // namespace

TEST_CASE("an odd bundle of any architecture acts or is refused, in bounded time and memory") {
  fuzz::Random random(1);
  int n_mutant = 0, n_answered = 0;
  for (const std::string& path : golden_bundles()) {
    CAPTURE(path);
    const std::string sound = read_text(path);
    const auto bundle = Bundle::parse(std::as_bytes(std::span(sound)), path);
    REQUIRE(bundle.ok());
    const auto first_tokens = bundle->keys().integers("action_tokens.required_ids", {0, 1e9});
    if (first_tokens && !first_tokens->empty()) continue;  // zeros are not answered with them
    CHECK(fuzz::check_act(sound));
    for (int round = 0; round < kRounds; ++round, ++n_mutant)
      n_answered += fuzz::check_act(fuzz::mutant(sound, random)) ? 1 : 0;
  }
  CHECK(n_answered > 0);
  CHECK(n_answered < n_mutant / 2);
}

TEST_CASE("an odd bundle for two robots lets both act, or is refused") {
  fuzz::Random random(1);
  const EditableBundle robot = EditableBundle::read(golden_path("gr00t_n1_6/faint") + "/bundle.gguf");
  const std::string sound = joint_bundle({{"arm", robot}, {"dog", robot}}, is_robots_own).bytes();
  CHECK(fuzz::check_act(sound));
  int n_answered = 0;
  for (int round = 0; round < kRounds; ++round) n_answered += fuzz::check_act(fuzz::mutant(sound, random)) ? 1 : 0;
  CHECK(n_answered > 0);
  CHECK(n_answered < kRounds);
}

}  // namespace mutated_test
