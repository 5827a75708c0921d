// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Sequences and chunks are recorded from the reference by tools/fast_tokens.py.
#include "processor/action_tokens.h"

#include <algorithm>
#include <cmath>
#include <random>

#include "processor/support.h"

namespace action_tokens_test {

using namespace vla;
using namespace vla::test;

namespace {

using Ids = std::vector<std::int32_t>;

const nlohmann::json& recorded() {
  static const nlohmann::json document = data_json("action_tokens.json");
  return document;
}

Keys recorded_keys() { return keys_of(recorded()["keys"]); }

ActionTokens make(const Keys& keys) {
  auto tokens = ActionTokens::read(keys);
  REQUIRE_MESSAGE(tokens.ok(), tokens.error().message());
  REQUIRE(tokens->has_value());
  return std::move(**tokens);
}

std::vector<float> decode(const ActionTokens& tokens, const Ids& ids, int horizon, int d_action, std::string& note) {
  auto chunk = tokens.decode(ids, horizon, d_action, &note);
  REQUIRE_MESSAGE(chunk.ok(), chunk.error().message());
  return *chunk;
}

/// A small vocabulary: tokens 0 to 4 are coefficients -2 to 2, 5 is two characters, 6 half of one and 7 the other half.
Keys small_keys() {
  Keys keys;
  keys.set("lm.n_vocab", std::int64_t{40});
  keys.set("solver.stop_token", std::int64_t{3});
  keys.set("action_tokens.kind", std::string("fast"));
  keys.set("action_tokens.vocab", std::vector<std::string>{"A", "B", "C", "D", "E", "CE", "Â", "¡", ""});
  keys.set("action_tokens.min_token", -67.0);
  keys.set("action_tokens.scale", 2.0);
  keys.set("action_tokens.first_id", std::int64_t{30});
  keys.set("action_tokens.prefix_ids", std::vector<std::int64_t>{5, 6});
  keys.set("action_tokens.required_ids", std::vector<std::int64_t>{});
  return keys;
}

/// The coefficients of an answer, one row of them: that has nothing to transform.
std::vector<float> row(const Ids& ids, int width, std::string& note) {
  return decode(make(small_keys()), ids, 1, width, note);
}

using Row = std::vector<float>;

}  // namespace

TEST_CASE("sequences of action tokens are decoded as the reference decodes them, or refused where it fails") {
  const ActionTokens tokens = make(recorded_keys());
  int n_refused = 0, n_moving = 0;
  for (const auto& sequence : recorded()["sequences"]) {
    const Ids ids = sequence["ids"];
    CAPTURE(ids);
    const auto chunk = tokens.decode(ids, recorded()["horizon"], recorded()["d_action"]);
    REQUIRE(chunk.ok() != sequence["chunk"].is_null());
    n_refused += !chunk.ok();
    if (!chunk) continue;
    const std::vector<float> expected = sequence["chunk"];
    REQUIRE(chunk->size() == expected.size());
    for (std::size_t i = 0; i < expected.size(); ++i) CHECK(std::abs((*chunk)[i] - expected[i]) <= 1e-6f);
    n_moving += std::any_of(expected.begin(), expected.end(), [](float value) { return std::abs(value) > 0.1f; });
  }
  CHECK(n_refused > 0);
  CHECK(n_moving > 10);
}

TEST_CASE("an answer ends at its stop, and its prefix is left out wherever it stands") {
  std::string note = "old";
  CHECK(row({5, 6, 30, 29, 5, 6, 28, 3, 26, 26}, 3, note) == Row{-1.0f, -0.5f, 0.0f});
  CHECK(note.empty());
  CHECK(row({30, 29, 28}, 3, note) == Row{-1.0f, -0.5f, 0.0f});  // one that never stops
  CHECK(row({5, 5, 6, 6, 30, 3}, 1, note) == Row{-1.0f});        // none is made by leaving another one out
}

TEST_CASE("an answer of too few or too many coefficients is filled with zeros or cut, and says so") {
  std::string note;
  CHECK(row({26, 3}, 3, note) == Row{1.0f, 0.0f, 0.0f});
  CHECK(note == "action tokens: 1 coefficients instead of 3, the rest are zeros");
  CHECK(row({25, 25, 3}, 3, note) == Row{0.0f, 1.0f, 0.0f});
  CHECK(note == "action tokens: 4 coefficients instead of 3, the last ones are left out");
  CHECK(row({3}, 2, note) == Row{0.0f, 0.0f});
  CHECK(contains(note, "0 coefficients"));
  CHECK(row({}, 2, note) == Row{0.0f, 0.0f});
}

TEST_CASE("ids that are no actions are passed over, or make a chunk of zeros where they stand above") {
  std::string note;
  CHECK(row({26, 10, 22, 0, 27, 3}, 2, note) == Row{1.0f, 0.5f});  // 22 has no text
  CHECK(note.empty());
  CHECK(row({26, 31, 27, 3}, 2, note) == Row{0.0f, 0.0f});
  CHECK(note == "action tokens: id 31 is no action, so the chunk is zeros");
}

TEST_CASE("bytes of several tokens make a character, and damaged ones the replacement character") {
  std::string note;
  CHECK(row({24, 23, 3}, 1, note) == Row{(0xA1 - 67) / 2.0f});
  CHECK(row({24, 26, 23, 3}, 3, note) == Row{(0xFFFD - 67) / 2.0f, 1.0f, (0xFFFD - 67) / 2.0f});
}

TEST_CASE("columns are transformed back on their own") {
  std::string note;
  const std::vector<float> chunk = decode(make(small_keys()), {26, 28, 30, 27, 3}, 2, 2, note);
  const double half = std::sqrt(0.5);
  const std::vector<double> expected = {half * (1 - 1), half * 0.5, half * (1 + 1), -half * 0.5};
  for (std::size_t i = 0; i < 4; ++i) CHECK(chunk[i] == doctest::Approx(expected[i]));
}

TEST_CASE("an answer without its required beginning is refused, and says what came") {
  Keys keys = small_keys();
  keys.set("action_tokens.required_ids", std::vector<std::int64_t>{5, 6});
  const ActionTokens tokens = make(keys);
  CHECK(tokens.decode(Ids{5, 6, 30}, 1, 1).ok());
  CHECK(refusal(tokens.decode(Ids{5, 30, 6}, 1, 1), Code::bad_action) ==
        "action tokens: expected ids 5, 6 first, found 5, 30; the policy did not answer with actions");
  CHECK(contains(refusal(tokens.decode(Ids{5}, 1, 1), Code::bad_action), "found 5"));
  CHECK(contains(refusal(tokens.decode(Ids{}, 1, 1), Code::bad_action), "found nothing"));
}

TEST_CASE("any sequence of ids is decoded or refused") {
  const ActionTokens tokens = make(recorded_keys());
  std::mt19937 random(7);
  for (int i = 0; i < 2000; ++i) {
    Ids ids(random() % 40);
    for (auto& id : ids) id = static_cast<std::int32_t>(random() % 800) - (i % 10 == 0 ? 30 : 0);
    ids.insert(ids.begin(), {318, 273});
    const auto chunk = tokens.decode(ids, 5, 7);
    const bool is_known = std::all_of(ids.begin(), ids.end(), [](std::int32_t id) { return id >= 0 && id < 727; });
    REQUIRE(chunk.ok() == is_known);
    if (chunk) REQUIRE(chunk->size() == 35);
  }
}

TEST_CASE("keys of action tokens that do not fit are refused") {
  CHECK_FALSE(ActionTokens::read(Keys())->has_value());
  const auto refused = [](const char* key, Value value) {
    Keys keys = small_keys();
    keys.set(std::string("action_tokens.") + key, std::move(value));
    return refusal(ActionTokens::read(keys), Code::bad_bundle);
  };
  using Numbers = std::vector<std::int64_t>;
  CHECK(contains(refused("kind", std::string("words")), "expected fast or bins, found words"));
  CHECK(contains(refused("vocab", std::vector<std::string>()), "action_tokens.vocab"));
  CHECK(contains(refused("min_token", 0.5), "a whole number, found 0.5"));
  CHECK(contains(refused("min_token", std::nan("")), "action_tokens.min_token"));
  CHECK(contains(refused("scale", 0.0), "action_tokens.scale"));
  CHECK(contains(refused("first_id", std::int64_t{40}), "0 to 39, found 40"));
  CHECK(contains(refused("prefix_ids", Numbers{}), "an id or several"));
  CHECK(contains(refused("prefix_ids", Numbers{-1}), "action_tokens.prefix_ids"));
  CHECK(contains(refused("required_ids", Numbers{40}), "action_tokens.required_ids"));
  Keys keys = small_keys();
  keys.set("solver.stop_token", std::int64_t{40});
  CHECK(contains(refusal(ActionTokens::read(keys), Code::bad_bundle), "solver.stop_token"));
}

TEST_CASE("a token of a bin stands for its centre, the nearest one where it names none") {
  Keys keys({{"action_tokens.kind", "bins"},
             {"action_tokens.n_bin", std::int64_t{5}},
             {"action_tokens.first_id", std::int64_t{11}},
             {"lm.n_vocab", std::int64_t{16}}});
  const ActionTokens tokens = make(keys);
  std::string note;
  CHECK(decode(tokens, {11, 10, 9, 8}, 2, 2, note) == std::vector<float>{-0.75f, -0.25f, 0.25f, 0.75f});
  CHECK(note.empty());
  CHECK(decode(tokens, {7}, 1, 1, note) == std::vector<float>{0.75f});  // the last id has the bin before it
  CHECK(note.empty());
  CHECK(decode(tokens, {15, 0}, 1, 2, note) == std::vector<float>{-0.75f, 0.75f});
  CHECK(contains(note, "id 0 is none of the 5 actions"));
  CHECK(contains(refusal(tokens.decode(Ids{11}, 1, 2), Code::bad_action), "found 1"));
  keys.set("action_tokens.first_id", std::int64_t{3});
  CHECK(contains(refusal(ActionTokens::read(keys), Code::bad_bundle), "action_tokens.n_bin"));
}

}  // namespace action_tokens_test
