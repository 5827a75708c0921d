// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/tokenizer.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <iterator>

#include "processor/nfc.h"
#include "processor/unicode.h"

namespace vla {
namespace {

constexpr std::size_t kMaxAround = 8;  // no real tokenizer adds more than two ids before or after a text

/// In the order of `kKinds`.
enum class Kind { byte_level, byte_fallback, wordpiece };
constexpr std::string_view kKinds[] = {"byte_level_bpe", "byte_fallback_bpe", "wordpiece"};

Result<Kind> read_kind(const Keys& keys) {
  VLA_TRY(const std::string kind, keys.string("tokenizer.kind"));
  const auto found = std::find(std::begin(kKinds), std::end(kKinds), kind);
  if (found != std::end(kKinds)) return static_cast<Kind>(found - std::begin(kKinds));
  return Error{Code::bad_bundle, "tokenizer.kind", fmt::format("{}", fmt::join(kKinds, " or ")), kind,
               "this bundle needs a newer vla"};
}

/// Reads the ids before or after every text.
Result<std::vector<std::int32_t>> read_around(const Keys& keys, const char* key, std::size_t n_token) {
  VLA_TRY(std::vector<std::int32_t> ids, keys.integers(key, {0, static_cast<double>(n_token) - 1.0}));
  if (ids.size() <= kMaxAround) return ids;
  return Error{Code::bad_bundle, key, "at most " + std::to_string(kMaxAround) + " ids", std::to_string(ids.size())};
}

/// For each id, whether it belongs to an added token.
std::vector<bool> are_added(const std::vector<AddedToken>& added, std::size_t n_token) {
  std::vector<bool> is_added(n_token);
  for (const AddedToken& token : added)
    if (token.id != kNoRow) is_added[static_cast<std::size_t>(token.id)] = true;
  return is_added;
}

/// Checks that `tokens` has the text of each added token at its id. With `whole_words`, when whole words may become
/// tokens, single-word tokens are refused: a skipped one could come back as a word of the model, and the bundle does
/// not state whether the model's vocabulary has it.
Status check_added(const std::vector<AddedToken>& added, const std::vector<std::string>& tokens, bool whole_words) {
  for (std::size_t i = 0; i < added.size(); ++i) {
    const std::string where = "tokenizer.added[" + std::to_string(i) + "]";
    if (whole_words && added[i].single_word)
      return Error{Code::bad_bundle, where + ".single_word", "false, because words may be tokens as a whole", "true"};
    if (added[i].id == kNoRow) continue;
    const auto id = static_cast<std::size_t>(added[i].id);
    if (id >= tokens.size() || tokens[id] != added[i].content)
      return Error{Code::bad_bundle, where + ".content", "the text of tokenizer.tokens[" + std::to_string(id) + "]",
                   added[i].content};
  }
  return {};
}

/// Reads the normalization of text between added tokens.
Status read_normalization(const Keys& keys, Kind kind, AddedTokens::Normalize& normalize) {
  constexpr const char* kKey = "tokenizer.normalization";
  normalize = kind == Kind::byte_fallback ? ByteFallbackBpe::mark_blanks : nullptr;
  if (!keys.has(kKey) && kind != Kind::wordpiece) return {};
  VLA_TRY(const std::string form, keys.string(kKey));
  if (kind == Kind::byte_level && form == "nfc") return normalize = nfc, Status();
  if (kind == Kind::byte_fallback && form == "blank_first")
    return normalize = ByteFallbackBpe::mark_blanks_and_first, Status();
  if (kind == Kind::wordpiece && form == "bert_uncased") return normalize = WordPiece::normalize, Status();
  constexpr const char* kExpected[] = {"nfc, or no such key", "blank_first, or no such key", "bert_uncased"};
  return Error{Code::bad_bundle, kKey, kExpected[static_cast<int>(kind)], form};
}

}  // namespace

Result<Tokenizer> Tokenizer::create(const Keys& keys, int n_vocab) {
  VLA_TRY(const Kind kind, read_kind(keys));
  VLA_TRY(const std::vector<std::string> tokens, keys.strings("tokenizer.tokens"));
  VLA_TRY(const std::string added_json, keys.string("tokenizer.added"));
  if (n_vocab < 1 || tokens.size() > static_cast<std::size_t>(n_vocab))
    return Error{Code::bad_bundle, "tokenizer.tokens", "at most " + std::to_string(n_vocab) + " tokens (lm.n_vocab)",
                 std::to_string(tokens.size())};
  VLA_TRY(std::vector<AddedToken> added, parse_added_tokens(added_json, n_vocab));

  Tokenizer tokenizer;
  if (kind == Kind::byte_level) {
    VLA_CHECK(tokenizer.read_byte_level(keys, tokens, added));
  } else if (kind == Kind::wordpiece) {
    VLA_CHECK(tokenizer.read_wordpiece(keys, tokens, added));
  } else {
    VLA_CHECK(check_added(added, tokens, false));
    VLA_CHECK(tokenizer.read_byte_fallback(keys, tokens));
  }
  AddedTokens::Normalize normalize = nullptr;
  VLA_CHECK(read_normalization(keys, kind, normalize));
  tokenizer.added_ = AddedTokens(std::move(added), normalize);
  return tokenizer;
}

Status Tokenizer::read_byte_level(const Keys& keys, const std::vector<std::string>& tokens,
                                  const std::vector<AddedToken>& added) {
  VLA_TRY(const std::vector<std::string> merges, keys.strings("tokenizer.merges"));
  VLA_TRY(const std::string pre, keys.string("tokenizer.pre"));
  VLA_TRY(const bool ignore_merges, keys.boolean("tokenizer.ignore_merges"));
  VLA_CHECK(check_added(added, tokens, ignore_merges));
  ByteLevel model;
  VLA_TRY(model.pretokenizer, Pretokenizer::parse(pre));
  VLA_TRY(model.bpe, Bpe::create(tokens, merges, ignore_merges, are_added(added, tokens.size())));
  model_ = std::move(model);
  for (const auto& [key, ids] : {std::pair("tokenizer.prefix_ids", &prefix_), {"tokenizer.suffix_ids", &suffix_}})
    if (keys.has(key)) {
      VLA_TRY(*ids, read_around(keys, key, tokens.size()));
    }
  return {};
}

Status Tokenizer::read_byte_fallback(const Keys& keys, const std::vector<std::string>& tokens) {
  VLA_TRY(const std::vector<std::string> merges, keys.strings("tokenizer.merges"));
  VLA_TRY(prefix_, read_around(keys, "tokenizer.prefix_ids", tokens.size()));
  if (keys.has("tokenizer.suffix_ids")) {
    VLA_TRY(suffix_, read_around(keys, "tokenizer.suffix_ids", tokens.size()));
  }
  VLA_TRY(model_, ByteFallbackBpe::create(tokens, merges));
  return {};
}

/// With this kind a whole word may become a token, so a skipped added token must not come back as one.
Status Tokenizer::read_wordpiece(const Keys& keys, const std::vector<std::string>& tokens,
                                 const std::vector<AddedToken>& added) {
  VLA_CHECK(check_added(added, tokens, true));
  VLA_TRY(prefix_, read_around(keys, "tokenizer.prefix_ids", tokens.size()));
  VLA_TRY(suffix_, read_around(keys, "tokenizer.suffix_ids", tokens.size()));
  VLA_TRY(const int unknown, keys.integer("tokenizer.unknown_id", {0, static_cast<double>(tokens.size()) - 1.0}));
  VLA_TRY(model_, WordPiece::create(tokens, are_added(added, tokens.size()), unknown));
  return {};
}

void Tokenizer::encode_piece(std::string_view piece, Ids& ids) const {
  if (const auto* fallback = std::get_if<ByteFallbackBpe>(&model_)) return fallback->encode(piece, ids);
  if (const auto* wordpiece = std::get_if<WordPiece>(&model_)) return wordpiece->encode(piece, ids);
  const auto& byte_level = std::get<ByteLevel>(model_);
  byte_level.pretokenizer.split(piece, [&](std::string_view word) { byte_level.bpe.encode(word, ids); });
}

Result<std::vector<std::int32_t>> Tokenizer::encode(std::string_view text, std::size_t max_bytes) const {
  if (text.size() > max_bytes)
    return Error{Code::bad_observation, "instruction", "at most " + std::to_string(max_bytes) + " bytes of text",
                 std::to_string(text.size()) + " bytes"};
  if (const std::size_t valid = unicode::valid_prefix(text); valid < text.size())
    return Error{Code::bad_observation, "instruction", "UTF-8 text",
                 "a byte that is not UTF-8 at offset " + std::to_string(valid)};
  Ids ids = prefix_;
  bool no_row = false;
  added_.split(
      text, [&](std::string_view piece) { encode_piece(piece, ids); },
      [&](std::int32_t id) {
        no_row |= id == kNoRow;
        ids.push_back(id);
      });
  if (no_row)
    return Error{Code::bad_observation, "instruction", "text without tokens that the embedding has no row for",
                 "such a token, e.g. <image>", "remove it from the text"};
  ids.insert(ids.end(), suffix_.begin(), suffix_.end());
  return ids;
}

}  // namespace vla
