// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/text.h"

#include "processor/ops/columns.h"
#include "processor/recipe.h"
#include "processor/support.h"

namespace text_test {

using namespace vla;
using namespace vla::test;

namespace {

constexpr Bins kBins = {-1.0, 1.0, 256};

/// The prompt as the recipe of pi0.5 makes it.
std::string prompt_of(const std::string& text, const std::vector<float>& state) {
  const std::string cleaned = replace_all(replace_all(strip(text), "_", " "), "\n", " ");
  return fill_template("Task: {instruction}, State: {state};\nAction: ", cleaned, bins(kBins, state));
}

}  // namespace

TEST_CASE("prompts with the state in words equal the reference's, letter by letter") {
  int compared = 0;
  for (const auto& test : data_json("prompts.json")) {
    CAPTURE(test["text"]);
    CHECK(prompt_of(test["text"], test["state"].get<std::vector<float>>()) == test["prompt"].get<std::string>());
    ++compared;
  }
  CHECK(compared == 8);
}

TEST_CASE("bins count edges exactly, where arithmetic in float32 would not") {
  const std::vector<float> values = {-1.5f, -1.0f, -1e-9f, -0.0f, 0.0f, 1e-9f, 0.9921874f, 0.9921875f, 1.0f, 1.5f};
  CHECK(bins(kBins, values) == std::vector<int>{-1, 0, 127, 128, 128, 128, 254, 255, 255, 255});
}

TEST_CASE("strip takes white space of every script and keeps what only looks like it") {
  CHECK(
      strip(
          " \t\n\v\f\r\x1c\x1d\x1e\x1f\u0085\u00a0\u1680\u2000\u200a\u2028\u2029\u202f\u205f\u3000a b\u3000\u0085 ") ==
      "a b");
  CHECK(strip("\u200b\ufeff\u180e") == "\u200b\ufeff\u180e");
  CHECK(strip(" \u2003 ").empty());
}

TEST_CASE("replace_all goes from left to right and does not look at what it has written") {
  CHECK(replace_all("aaa", "aa", "a") == "aa");
  CHECK(replace_all("a_b__", "_", "__") == "a__b____");
  CHECK(replace_all("ab", "c", "d") == "ab");
}

TEST_CASE("an instruction with a text that the recipe refuses is refused, and ops before it are refused too") {
  const auto parsed = [](const std::string& ops) {
    return parse_recipe(
        R"({"image": [{"op": "resize", "width": 2, "height": 2, "filter": "torch_bilinear"}], "text": [)" + ops +
        R"({"op": "tokenize", "max_tokens": 8, "truncate": "left"}], "state": [], "action": []})");
  };
  const std::string ops = R"({"op": "refuse", "text": "<|a|>"}, {"op": "refuse", "text": "<|b|>"},)";
  const auto recipe = parsed(ops);
  REQUIRE_MESSAGE(recipe.ok(), recipe.error().message());
  CHECK(*recipe->text.at(1)->apply("go <|a|", {}) == "go <|a|");
  CHECK(contains(refusal(recipe->text.at(1)->apply("go <|b|>", {}), Code::bad_observation),
                 "instruction: expected text without <|b|>"));
  CHECK(contains(refusal(parsed(R"({"op": "strip"},)" + ops), Code::bad_bundle), "text[1].op"));
  CHECK(contains(refusal(parsed(R"({"op": "refuse", "text": ""},)"), Code::bad_bundle), "text[0].text"));
}

}  // namespace text_test
