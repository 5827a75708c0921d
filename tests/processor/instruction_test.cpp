// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/processor.h"
#include "processor/sample.h"

namespace instruction_test {

using namespace vla;
using namespace vla::test;
using Json = nlohmann::json;

namespace {

/// Puts a WordPiece tokenizer in the place of the sample's BPE.
void set_wordpiece(EditableBundle& bundle, const Keys& tokenizer) {
  for (const auto& [key, value] : tokenizer.all()) bundle.set(key, value);
  for (const char* key : {"tokenizer.pre", "tokenizer.ignore_merges", "tokenizer.merges"}) bundle.remove_key(key);
}

/// A bundle of a policy that reads no instruction.
EditableBundle wordless() {
  EditableBundle bundle = sample();
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  recipe["text"] = Json::array();
  bundle.set("processor.recipe", recipe.dump());
  bundle.set("observation.max_text_tokens", std::int64_t{0});
  bundle.remove_key("lm.n_vocab");
  return bundle;
}

}  // namespace

TEST_CASE("an instruction in another script has a note") {
  const auto notes_on = [](const char* text) {
    Observation seen = observation();
    seen.text = text;
    return make().encode(seen)->notes;
  };
  CHECK(notes_on("\u00e8 \u2192").empty());
  for (const char* text : {"\u53d6", "\u0431", "a \u03b2"})
    CHECK(contains(notes_on(text).at(0), "instruction: letters of another script"));
}

TEST_CASE("a long instruction is cut on the right with a note") {
  Observation seen = observation();
  const auto whole =
      *Tokenizer::create(tokenizer_keys("smol"), 4096)->encode("pick up the red cube and place it in the bowl\n");
  seen.text = "pick up the red cube and place it in the bowl";
  const auto inputs = make().encode(seen);
  REQUIRE(inputs.ok());
  REQUIRE(inputs->notes.size() == 1);
  CHECK(inputs->notes[0] == "instruction: 13 tokens, cut to the first 8");
  CHECK(inputs->tokens == std::vector<std::int32_t>(whole.begin(), whole.begin() + 8));
}

TEST_CASE("a tokenizer that cuts on the left keeps the end of a long instruction") {
  EditableBundle bundle = sample();
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  recipe["text"][1]["truncate"] = "left";
  bundle.set("processor.recipe", recipe.dump());
  Observation seen = observation();
  seen.text = "pick up the red cube and place it in the bowl";
  const auto whole = *Tokenizer::create(tokenizer_keys("smol"), 4096)->encode(*seen.text + "\n");
  const auto inputs = make(bundle).encode(seen);
  REQUIRE(inputs.ok());
  CHECK(inputs->notes[0] == "instruction: 13 tokens, cut to the last 8");
  CHECK(inputs->tokens == std::vector<std::int32_t>(whole.end() - 8, whole.end()));
}

TEST_CASE("the suffix is added once") {
  Observation once = observation(), twice = observation();
  once.text = "pick up";
  twice.text = "pick up\n";
  CHECK(make().encode(once)->tokens == make().encode(twice)->tokens);
}

TEST_CASE("an empty instruction is one, and has a note") {
  Observation empty = observation(), blank = observation();
  empty.text = "";
  blank.text = "\n";  // the suffix alone
  const auto inputs = make().encode(empty);
  REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
  CHECK(inputs->tokens == make().encode(blank)->tokens);
  CHECK(inputs->notes == std::vector<std::string>{"instruction: empty"});
  CHECK(make().encode(blank)->notes.empty());
}

TEST_CASE("instructions that are not given, too long or not UTF-8 are refused") {
  const auto refused = [](const Observation& o) { return refusal(make().encode(o), Code::bad_observation); };
  Observation bad = observation();
  bad.text.reset();
  CHECK(contains(refused(bad), "instruction: expected a text, found none; give an empty one if that is meant"));
  bad.text = std::string(100'000, 'a');
  CHECK(contains(refused(bad), "instruction: expected at most 65536 bytes"));
  bad.text = "pick \xc3 up";
  CHECK(contains(refused(bad), "instruction: expected UTF-8 text"));
}

TEST_CASE("a text that is cut at its start keeps what stands in front of every text") {
  EditableBundle bundle = sample();
  const Keys gemma = tokenizer_keys("gemma");
  for (const auto& [key, value] : gemma.all()) bundle.set(key, value);
  for (const char* key : {"tokenizer.pre", "tokenizer.ignore_merges"}) bundle.remove_key(key);
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  Observation seen = observation();
  seen.text = "pick up the red cube and place it in the bowl";
  recipe["text"][1]["max_tokens"] = 4;
  for (const char* side : {"right", "left"}) {
    recipe["text"][1]["truncate"] = side;
    bundle.set("processor.recipe", recipe.dump());
    const auto inputs = make(bundle).encode(seen);
    REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
    CHECK(inputs->tokens.size() == 4);
    CHECK(inputs->tokens.front() == 2);
    CHECK(inputs->notes.size() == 1);
    const auto all = *Tokenizer::create(tokenizer_keys("gemma"), 4096)->encode(*seen.text + "\n");
    CHECK(inputs->tokens[1] == (std::string(side) == "right" ? all[1] : all[all.size() - 3]));
  }
}

TEST_CASE("a text that is cut keeps what stands around every text") {
  EditableBundle bundle = sample();
  const Keys bert = tokenizer_keys("bert");
  set_wordpiece(bundle, bert);
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  Observation seen = observation();
  seen.text = "pick up the red cube and place it in the bowl";
  const auto all = *Tokenizer::create(bert, 4096)->encode(*seen.text);
  const auto cut_to = [&](int n, const char* side) {
    recipe["text"][1]["max_tokens"] = n;
    recipe["text"][1]["truncate"] = side;
    bundle.set("processor.recipe", recipe.dump());
    const auto inputs = make(bundle).encode(seen);
    REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
    return inputs->tokens;
  };
  using Ids = std::vector<std::int32_t>;
  CHECK(cut_to(4, "right") == Ids{all.front(), all[1], all[2], all.back()});
  CHECK(cut_to(4, "left") == Ids{all.front(), all[all.size() - 3], all[all.size() - 2], all.back()});
  CHECK(cut_to(2, "right") == Ids{all.front(), all.back()});
  CHECK(cut_to(2, "left") == Ids{all.front(), all.back()});
  recipe["text"][1]["max_tokens"] = 1;
  bundle.set("processor.recipe", recipe.dump());
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "2 tokens or more, which stand around every text"));
}

TEST_CASE("a text is filled up to its limit, which single instructions have of their own") {
  EditableBundle bundle = sample();
  const Keys bert = tokenizer_keys("bert");
  set_wordpiece(bundle, bert);
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  const Json limit = {{"op", "limit"}, {"max_tokens", 5}, {"instructions", {"open it now", "push"}}};
  recipe["text"] = {limit, {{"op", "tokenize"}, {"max_tokens", 8}, {"truncate", "right"}, {"pad_id", 0}}};
  bundle.set("processor.recipe", recipe.dump());
  const Processor processor = make(bundle);
  const auto tokens = [&](const std::string& text) {
    Observation seen = observation();
    seen.text = text;
    return processor.encode(seen)->tokens;
  };
  for (const char* text : {"push", "open it now", "push ", "Push", "open the door"}) {
    CAPTURE(text);
    const bool is_named = std::string(text) == "push" || std::string(text) == "open it now";
    auto expected = *Tokenizer::create(bert, 4096)->encode(text);
    const std::size_t n = is_named ? 5 : 8;
    if (expected.size() > n) expected.erase(expected.begin() + static_cast<std::ptrdiff_t>(n) - 1, expected.end() - 1);
    expected.resize(n, 0);
    CHECK(tokens(text) == expected);
  }
  const auto refused_with = [&](const char* field, const Json& value) {
    Json changed = recipe;
    changed["text"][std::string(field) == "pad_id" ? 1 : 0][field] = value;
    bundle.set("processor.recipe", changed.dump());
    return refusal(create(bundle), Code::bad_bundle);
  };
  CHECK(contains(refused_with("pad_id", 1 << 20), "a pad_id below"));
  CHECK(contains(refused_with("max_tokens", 10), "at least the limit 10"));
  CHECK(contains(refused_with("max_tokens", 1), "2 tokens or more, which stand around every text"));
  CHECK(contains(refused_with("instructions", {"push", "push"}), "a list of different strings"));
  CHECK(contains(refused_with("instructions", {""}), "that are not empty"));
}

TEST_CASE("a prompt that ops would blow up is refused before it is made") {
  EditableBundle bundle = sample();
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  const std::string thousand(1000, 'a');
  const Json replace = {{"op", "replace"}, {"from", "a"}, {"to", thousand}};
  for (int i = 0; i < 4; ++i) recipe["text"].insert(recipe["text"].begin(), replace);
  bundle.set("processor.recipe", recipe.dump());
  Observation seen = observation();
  const Processor processor = make(bundle);
  seen.text = "a";
  CHECK(contains(refusal(processor.encode(seen), Code::bad_observation), "bytes, found 1000000000"));
  seen.text = "pick up";
  CHECK(processor.encode(seen).ok());
}

TEST_CASE("a policy that reads no instruction needs no tokenizer, and notes an instruction that is given") {
  EditableBundle bundle = wordless();
  bundle.remove_key("tokenizer.kind");
  const Processor processor = make(bundle);
  CHECK(processor.tokenizer() == nullptr);
  Observation seen = observation();
  seen.text.reset();
  const auto silent = processor.encode(seen), told = processor.encode(observation());
  seen.text = "";
  CHECK(processor.encode(seen)->notes.empty());
  REQUIRE_MESSAGE(silent.ok(), silent.error().message());
  REQUIRE_MESSAGE(told.ok(), told.error().message());
  CHECK(silent->notes.empty());
  REQUIRE(told->notes.size() == 1);
  CHECK(contains(told->notes[0], "instruction: not read"));
  CHECK(silent->tokens.empty());
  CHECK(told->tokens.empty());
  CHECK(told->pixels == silent->pixels);
}

TEST_CASE("a recipe without a text and a vocabulary, or a text without one, are refused") {
  EditableBundle bundle = wordless();
  bundle.set("lm.n_vocab", std::int64_t{4096});
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "processor.recipe.text: expected tokenize"));
  bundle = sample();
  bundle.remove_key("lm.n_vocab");
  CHECK(
      contains(refusal(create(bundle), Code::bad_bundle), "processor.recipe.text: expected none, without lm.n_vocab"));
  bundle = wordless();
  bundle.set("observation.max_text_tokens", std::int64_t{8});
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "observation.max_text_tokens"));
}

}  // namespace instruction_test
