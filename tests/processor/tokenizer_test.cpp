// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/tokenizer.h"

#include <algorithm>
#include <chrono>
#include <ctime>

#include "processor/nfc.h"
#include "processor/support.h"
#include "processor/unicode.h"

namespace tokenizer_test {

using namespace vla;
using namespace vla::test;
using Json = nlohmann::json;

namespace {

constexpr int kVocab = 4096;

Tokenizer make(const Keys& keys) {
  auto tokenizer = Tokenizer::create(keys, kVocab);
  REQUIRE_MESSAGE(tokenizer.ok(), tokenizer.error().message());
  return std::move(*tokenizer);
}

Tokenizer load(const std::string& name) { return make(tokenizer_keys(name)); }

std::vector<std::int32_t> encode(const Tokenizer& tokenizer, const std::string& text) {
  auto ids = tokenizer.encode(text);
  REQUIRE_MESSAGE(ids.ok(), ids.error().message());
  return *ids;
}

std::string refused_keys(const Keys& keys, int n_vocab = kVocab) {
  return refusal(Tokenizer::create(keys, n_vocab), Code::bad_bundle);
}

std::string refused_text(const std::string& text) { return refusal(load("smol").encode(text), Code::bad_observation); }

/// Changes the first added token of a tokenizer and gives the refusal.
std::string refused_added(const std::string& tokenizer, const char* field, const Json& value) {
  Keys keys = tokenizer_keys(tokenizer);
  Json added = Json::parse(*keys.string("tokenizer.added"));
  if (value.is_discarded()) {
    added[0].erase(field);
  } else {
    added[0][field] = value;
  }
  keys.set("tokenizer.added", added.dump());
  return refused_keys(keys);
}

}  // namespace

TEST_CASE("twelve tokenizers give the reference's ids on six thousand texts") {
  int compared = 0;
  const Json all = data_json("tokenizer_cases.json");
  for (const auto& item : all.items()) {
    const Tokenizer tokenizer = load(item.key());
    for (const Json& text_and_ids : item.value()) {
      const std::string text = text_and_ids[0];
      CAPTURE(item.key());
      CAPTURE(text);
      const std::vector<std::int32_t> expected(text_and_ids.begin() + 1, text_and_ids.end());
      CHECK(encode(tokenizer, text) == expected);
      ++compared;
    }
  }
  CHECK(compared == 6500);
}

TEST_CASE("a word of 64 KiB takes milliseconds") {
  for (const char* name : {"smol", "tangled", "qwen", "llama", "gemma", "bert", "bart"}) {
    const Keys keys = tokenizer_keys(name);
    std::string longest, word;  // repeated, the longest token of letters merges most
    const auto tokens = *keys.strings("tokenizer.tokens");
    for (const std::string& token : tokens)
      if (token.size() > longest.size() && token.find_first_not_of("abcdefghijklmnopqrstuvwxyz") == std::string::npos)
        longest = token;
    while (word.size() + longest.size() <= Tokenizer::kMaxText) word += longest;
    const Tokenizer tokenizer = make(keys);
    const auto start = std::chrono::steady_clock::now();
    CHECK(encode(tokenizer, word).size() < word.size() / 2);
    // Quadratic merging takes minutes; the bound leaves room for sanitizers and a busy machine.
    CHECK(std::chrono::steady_clock::now() - start < std::chrono::seconds(3));
  }
}

TEST_CASE("NUL is a character like any other") {
  const Tokenizer tokenizer = load("smol");
  std::vector<std::int32_t> expected = encode(tokenizer, "a");
  const auto nul = encode(tokenizer, std::string(1, '\0'));
  CHECK(nul.size() == 1);
  expected.insert(expected.end(), nul.begin(), nul.end());
  CHECK(encode(tokenizer, std::string("a\0", 2)) == expected);
}

TEST_CASE("empty text has no tokens but those that stand in front of every text") {
  CHECK(encode(load("awkward"), "").empty());
  CHECK(encode(load("gemma"), "") == std::vector<std::int32_t>{2});
  CHECK(load("gemma").prefix() == std::vector<std::int32_t>{2});
}

TEST_CASE("a blank stands in front of every text between added tokens where the keys say so") {
  Keys keys = tokenizer_keys("gemma");
  keys.set("tokenizer.normalization", std::string("blank_first"));
  const Tokenizer tokenizer = make(keys), plain = load("gemma");
  const std::pair<const char*, const char*> cases[] = {{"", ""},
                                                       {"pick", " pick"},
                                                       {" pick", "  pick"},
                                                       {"pick<bos>up ", " pick<bos> up "},
                                                       {"<bos><bos> a", "<bos><bos>  a"}};
  for (const auto& [text, spelt] : cases) CHECK(encode(tokenizer, text) == encode(plain, spelt));
}

TEST_CASE("text with a token that the embedding has no row for is refused") {
  Keys keys = tokenizer_keys("gemma");
  Json added = Json::parse(*keys.string("tokenizer.added"));
  for (const char* content : {"<image>", "<video>"}) {
    Json token = added[0];
    token["content"] = content;
    token["id"] = kNoRow;
    added.push_back(token);
  }
  keys.set("tokenizer.added", added.dump());
  const Tokenizer tokenizer = make(keys);
  CHECK(contains(refusal(tokenizer.encode("pick <image> up"), Code::bad_observation), "no row"));
  CHECK(encode(tokenizer, "pick <imag") == encode(load("gemma"), "pick <imag"));
}

TEST_CASE("ids in front that are no tokens, too many of them, or a missing byte are refused") {
  Keys keys = tokenizer_keys("gemma");
  keys.set("tokenizer.prefix_ids", std::vector<std::int64_t>{kVocab});
  CHECK(contains(refused_keys(keys), "tokenizer.prefix_ids"));
  keys.set("tokenizer.prefix_ids", std::vector<std::int64_t>(9, 2));
  CHECK(contains(refused_keys(keys), "tokenizer.prefix_ids"));
  keys = tokenizer_keys("gemma");
  auto tokens = *keys.strings("tokenizer.tokens");
  *std::find(tokens.begin(), tokens.end(), "<0x7F>") = "<0x7f>";
  keys.set("tokenizer.tokens", tokens);
  CHECK(contains(refused_keys(keys), "<0x7F>"));
}

TEST_CASE("text that is not UTF-8 is refused at its first bad byte") {
  const std::string bad[] = {"\xff",     "\xc0\x80",         "\xc1\xbf",         "\xe0\x80\x80",     "\xed\xa0\x80",
                             "\xe2\x82", "\xf0\x80\x80\x80", "\xf4\x90\x80\x80", "\xf5\x80\x80\x80", "\x80"};
  for (const std::string& tail : bad) CHECK(contains(refused_text("go" + tail), "offset 2"));
}

TEST_CASE("text beyond 64 KiB is refused and text of 64 KiB is not") {
  CHECK(contains(refused_text(std::string(Tokenizer::kMaxText + 1, 'a')), "65537 bytes"));
  CHECK(load("smol").encode(std::string(Tokenizer::kMaxText, 'a')).ok());
  CHECK(load("smol").encode(std::string(Tokenizer::kMaxText + 1, 'a'), Tokenizer::kMaxText + 1).ok());
}

TEST_CASE("first and last agree on every code point") {
  for (std::uint32_t c : {0u, 0x7Fu, 0x80u, 0x7FFu, 0x800u, 0xD7FFu, 0xE000u, 0xFFFFu, 0x10000u, 0x10FFFFu}) {
    std::string text = c < 0x80    ? std::string(1, static_cast<char>(c))
                       : c < 0x800 ? std::string{static_cast<char>(0xC0 | c >> 6), static_cast<char>(0x80 | (c & 63))}
                       : c < 0x10000
                           ? std::string{static_cast<char>(0xE0 | c >> 12), static_cast<char>(0x80 | (c >> 6 & 63)),
                                         static_cast<char>(0x80 | (c & 63))}
                           : std::string{static_cast<char>(0xF0 | c >> 18), static_cast<char>(0x80 | (c >> 12 & 63)),
                                         static_cast<char>(0x80 | (c >> 6 & 63)), static_cast<char>(0x80 | (c & 63))};
    CHECK(unicode::first(text).code_point == c);
    CHECK(unicode::first(text).size == text.size());
    CHECK(unicode::last("xy" + text).code_point == c);
  }
}

TEST_CASE("a vocabulary larger than the embedding is refused") {
  const Keys keys = tokenizer_keys("smol");
  const int size = static_cast<int>(keys.strings("tokenizer.tokens")->size());
  CHECK(Tokenizer::create(keys, size).ok());
  CHECK(contains(refused_keys(keys, size - 1), "lm.n_vocab"));
}

TEST_CASE("a vocabulary without a byte, or with a text twice or empty, is refused") {
  for (const std::string& text : {std::string("no byte"), std::string("a"), std::string()}) {
    Keys keys = tokenizer_keys("tangled");
    auto tokens = *keys.strings("tokenizer.tokens");
    tokens[40] = text;
    keys.set("tokenizer.tokens", tokens);
    CHECK(contains(refused_keys(keys), "tokenizer.tokens"));
  }
}

TEST_CASE("a byte may lack a token where its character is one, as the tab of Gemma's published file") {
  const auto without = [](const char* symbol) {
    Keys keys = tokenizer_keys("gemma");
    auto tokens = *keys.strings("tokenizer.tokens");
    *std::find(tokens.begin(), tokens.end(), symbol) = "no byte";
    keys.set("tokenizer.tokens", tokens);
    return keys;
  };
  const std::string text = "a\tb \t\tc";
  CHECK(encode(make(without("<0x09>")), text) == encode(load("gemma"), text));
  CHECK(contains(refused_keys(without("<0x01>")), "none for <0x01>"));
  CHECK(contains(refused_keys(without("<0xC3>")), "none for <0xC3>"));
}

TEST_CASE("merges of what is not a token, or without two parts, are refused at their rank") {
  for (const char* merge : {"a", "a b c", "", " ", "a nothing", "nothing a", "Ā Ā"}) {
    Keys keys = tokenizer_keys("tangled");
    auto merges = *keys.strings("tokenizer.merges");
    merges[5] = merge;
    keys.set("tokenizer.merges", merges);
    CHECK(contains(refused_keys(keys), "tokenizer.merges[5]"));
  }
}

TEST_CASE("added tokens are checked field by field") {
  CHECK(contains(refused_added("smol", "id", 4096), "tokenizer.added[0].id"));
  CHECK(contains(refused_added("smol", "id", "0"), "tokenizer.added[0].id"));
  CHECK(contains(refused_added("smol", "id", 1), "tokenizer.added"));
  CHECK(contains(refused_added("smol", "content", ""), "tokenizer.added[0].content"));
  CHECK(contains(refused_added("smol", "content", "<other>"), "tokenizer.added[0].content"));
  CHECK(contains(refused_added("smol", "content", std::string(257, 'x')), "256 bytes"));
  CHECK(contains(refused_added("smol", "lstrip", 1), "tokenizer.added[0].lstrip"));
  CHECK(contains(refused_added("smol", "special", Json(Json::value_t::discarded)), "no such field"));
  CHECK(contains(refused_added("smol", "extra", true), "unknown field"));
  CHECK(contains(refused_added("whole", "single_word", true), "tokenizer.added[0].single_word"));
}

TEST_CASE("pre-tokenizer steps that the runtime does not know are refused") {
  const std::pair<const char*, const char*> cases[] = {
      {"not json", "tokenizer.pre"},
      {"{}", "a JSON list"},
      {"[]", "byte_level"},
      {R"([{"type":"digits","individual":true}])", "byte_level"},
      {R"([{"type":"metaspace"}])", "tokenizer.pre[0].type"},
      {R"([{"type":"split"}])", "tokenizer.pre[0].pattern"},
      {R"([{"type":"split","pattern":"\\s+"}])", "tokenizer.pre[0].pattern"},
      {R"([{"type":"digits"}])", "tokenizer.pre[0].individual"},
      {R"([{"type":"byte_level","add_prefix_space":false}])", "tokenizer.pre[0].use_regex"},
      {R"([{"type":"byte_level","add_prefix_space":false,"use_regex":1}])", "true or false"},
      {R"([{"type":"byte_level","add_prefix_space":false,"use_regex":true},{"type":"digits","individual":true}])",
       "tokenizer.pre[1]"},
      {R"([0])", "tokenizer.pre[0]"},
      {R"([0,0,0,0,0,0,0,0,0])", "at most 8 steps"},
  };
  for (const auto& [pre, part] : cases) {
    Keys keys = tokenizer_keys("smol");
    keys.set("tokenizer.pre", std::string(pre));
    CHECK(contains(refused_keys(keys), part));
  }
}

TEST_CASE("another normalization is refused") {
  Keys keys = tokenizer_keys("qwen");
  keys.set("tokenizer.normalization", std::string("nfkc"));
  CHECK(contains(refused_keys(keys), "tokenizer.normalization: expected nfc, or no such key, found nfkc"));
  keys = tokenizer_keys("gemma");
  keys.set("tokenizer.normalization", std::string("nfc"));
  CHECK(contains(refused_keys(keys), "tokenizer.normalization"));
}

TEST_CASE("composing a text of nothing but marks takes no quadratic time") {
  std::string marks = "e", ordered = "\u1eb9";  // a mark below sorts before one above, and composes with the letter
  for (int i = 0; i < 16000; ++i) marks += "\u0301\u0323";
  for (int i = 0; i < 15999; ++i) ordered += "\u0323";
  for (int i = 0; i < 16000; ++i) ordered += "\u0301";
  const std::clock_t start = std::clock();  // of this process alone, however busy the machine is
  CHECK(nfc(marks) == ordered);
  CHECK(std::clock() - start < CLOCKS_PER_SEC);
}

TEST_CASE("added tokens of white space take no quadratic time") {
  Keys keys = tokenizer_keys("smol");
  auto tokens = *keys.strings("tokenizer.tokens");
  Json added = Json::parse(*keys.string("tokenizer.added"));
  added.push_back({{"id", tokens.size()},
                   {"content", "\t"},
                   {"single_word", false},
                   {"lstrip", true},
                   {"rstrip", true},
                   {"normalized", false},
                   {"special", true}});
  tokens.push_back("\t");
  keys.set("tokenizer.tokens", tokens);
  keys.set("tokenizer.added", added.dump());
  const auto tokenizer = Tokenizer::create(keys, 4096);
  REQUIRE_MESSAGE(tokenizer.ok(), tokenizer.error().message());
  const std::clock_t start = std::clock();
  CHECK(tokenizer->encode(std::string(Tokenizer::kMaxText, '\t')).ok());
  CHECK(std::clock() - start < CLOCKS_PER_SEC);
}

TEST_CASE("composing text is Unicode's, but for characters that the reference does not know") {
  CHECK(nfc("cafe\u0301 A\u030a \u212b \u1100\u1161\u11a8") == "caf\u00e9 \u00c5 \u00c5 \uac01");
  CHECK(nfc("a\u0327\u0301 a\u0301\u0327") == "\u00e1\u0327 \u00e1\u0327");
  CHECK(nfc("\U00011935\U00011930") == "\U00011935\U00011930");  // one character since Unicode 13
  CHECK(nfc(std::string("e\0\u0301", 4)) == std::string("e\0\u0301", 4));
  CHECK(nfc("") == "");
}

TEST_CASE("another kind of tokenizer and a missing key are refused") {
  Keys keys = tokenizer_keys("smol");
  keys.set("tokenizer.kind", std::string("sentencepiece"));
  CHECK(contains(refused_keys(keys),
                 "tokenizer.kind: expected byte_level_bpe or byte_fallback_bpe or wordpiece, found sentencepiece"));
  for (const char* key : {"tokenizer.kind", "tokenizer.tokens", "tokenizer.merges", "tokenizer.pre", "tokenizer.added",
                          "tokenizer.ignore_merges"}) {
    auto values = tokenizer_keys("smol").all();
    values.erase(values.find(key));
    CHECK(contains(refused_keys(Keys(values)), key));
  }
}

TEST_CASE("a word of BERT's is cut from the left into its longest tokens, or unknown as a whole") {
  Keys keys = tokenizer_keys("bert");
  keys.set("tokenizer.tokens",
           std::vector<std::string>{"[UNK]", "un", "able", "##want", "##w", "##able", "##d", "a", "##a"});
  keys.set("tokenizer.added", std::string("[]"));
  keys.set("tokenizer.unknown_id", std::int64_t{0});
  keys.set("tokenizer.prefix_ids", std::vector<std::int64_t>{});
  keys.set("tokenizer.suffix_ids", std::vector<std::int64_t>{});
  const Tokenizer tokenizer = make(keys);
  const std::vector<std::int32_t> unwantable = {1, 3, 5}, two = {1, 4, 5, 0, 2};
  CHECK(encode(tokenizer, "  UNWantABLE") == unwantable);
  CHECK(encode(tokenizer, "unwable - able") == two);
  CHECK(encode(tokenizer, "unwants") == std::vector<std::int32_t>{0});
  CHECK(encode(tokenizer, std::string(100, 'a')).size() == 100);
  CHECK(encode(tokenizer, std::string(101, 'a')) == std::vector<std::int32_t>{0});
}

TEST_CASE("normalization for BERT takes capitals, accents and control characters from text") {
  CHECK(WordPiece::normalize("Caf\u00c9\u0301 \u0130Z\u200b\u0001\t\u00c5") == "cafe iz a");
  CHECK(WordPiece::normalize("a\u4e2d") == "a \u4e2d ");
  CHECK(WordPiece::normalize("\uac00") == "\u1100\u1161");
  CHECK(WordPiece::normalize(std::string("a\0b\ufffd", 6)) == "ab");
}

TEST_CASE("the keys of a WordPiece tokenizer are checked") {
  for (const char* key :
       {"tokenizer.normalization", "tokenizer.prefix_ids", "tokenizer.suffix_ids", "tokenizer.unknown_id"}) {
    auto values = tokenizer_keys("bert").all();
    values.erase(values.find(key));
    CHECK(contains(refused_keys(Keys(values)), key));
  }
  Keys keys = tokenizer_keys("bert");
  keys.set("tokenizer.normalization", std::string("nfc"));
  CHECK(contains(refused_keys(keys), "tokenizer.normalization: expected bert_uncased, found nfc"));
  keys = tokenizer_keys("bert");
  keys.set("tokenizer.suffix_ids", std::vector<std::int64_t>(9, 2));
  CHECK(contains(refused_keys(keys), "tokenizer.suffix_ids"));
  keys = tokenizer_keys("bert");
  keys.set("tokenizer.unknown_id", std::int64_t{kVocab});
  CHECK(contains(refused_keys(keys), "tokenizer.unknown_id"));
  auto tokens = *tokenizer_keys("bert").strings("tokenizer.tokens");
  tokens.push_back(tokens.back());
  keys = tokenizer_keys("bert");
  keys.set("tokenizer.tokens", tokens);
  CHECK(contains(refused_keys(keys), "every token once"));
  CHECK(contains(refused_added("bert", "single_word", true), "single_word"));
}

}  // namespace tokenizer_test
