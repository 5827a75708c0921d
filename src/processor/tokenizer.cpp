// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/tokenizer.h"

#include "processor/nfc.h"
#include "processor/unicode.h"

namespace vla {
namespace {

constexpr std::size_t kMaxPrefix = 8;  // no real tokenizer puts more than two ids in front

Result<bool> is_byte_level(const Keys& keys) {
  VLA_TRY(const std::string kind, keys.string("tokenizer.kind"));
  if (kind == "byte_level_bpe" || kind == "byte_fallback_bpe") return kind == "byte_level_bpe";
  return Error{Code::bad_bundle, "tokenizer.kind", "byte_level_bpe or byte_fallback_bpe", kind,
               "this bundle needs a newer vla"};
}

/// The text of an added token is in the list of tokens too, so that the list is complete.
/// `whole_words`: a single word token that is passed over could come back as a word of the model, and the bundle does
/// not say whether the model's own vocabulary has it.
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

/// Whether text between the added tokens is composed.
Result<bool> is_composed(const Keys& keys, bool byte_level) {
  constexpr const char* kKey = "tokenizer.normalization";
  if (!keys.has(kKey)) return false;
  VLA_TRY(const std::string form, keys.string(kKey));
  if (byte_level && form == "nfc") return true;
  return Error{Code::bad_bundle, kKey, byte_level ? "nfc, or no such key" : "no such key beside byte_fallback_bpe",
               form};
}

}  // namespace

Result<Tokenizer> Tokenizer::create(const Keys& keys, int n_vocab) {
  VLA_TRY(const bool byte_level, is_byte_level(keys));
  VLA_TRY(const std::vector<std::string> tokens, keys.strings("tokenizer.tokens"));
  VLA_TRY(const std::string added_json, keys.string("tokenizer.added"));
  if (n_vocab < 1 || tokens.size() > static_cast<std::size_t>(n_vocab))
    return Error{Code::bad_bundle, "tokenizer.tokens", "at most " + std::to_string(n_vocab) + " tokens (lm.n_vocab)",
                 std::to_string(tokens.size())};
  VLA_TRY(std::vector<AddedToken> added, parse_added_tokens(added_json, n_vocab));

  Tokenizer tokenizer;
  if (byte_level) {
    VLA_CHECK(tokenizer.read_byte_level(keys, tokens, added));
  } else {
    VLA_CHECK(check_added(added, tokens, false));
    VLA_CHECK(tokenizer.read_byte_fallback(keys, tokens));
  }
  VLA_TRY(const bool composed, is_composed(keys, byte_level));
  AddedTokens::Normalize normalize = byte_level ? nullptr : ByteFallbackBpe::mark_blanks;
  if (composed) normalize = nfc;
  tokenizer.added_ = AddedTokens(std::move(added), normalize);
  return tokenizer;
}

Status Tokenizer::read_byte_level(const Keys& keys, const std::vector<std::string>& tokens,
                                  const std::vector<AddedToken>& added) {
  VLA_TRY(const std::vector<std::string> merges, keys.strings("tokenizer.merges"));
  VLA_TRY(const std::string pre, keys.string("tokenizer.pre"));
  VLA_TRY(const bool ignore_merges, keys.boolean("tokenizer.ignore_merges"));
  VLA_CHECK(check_added(added, tokens, ignore_merges));
  std::vector<bool> is_added(tokens.size());
  for (const AddedToken& token : added)
    if (token.id != kNoRow) is_added[static_cast<std::size_t>(token.id)] = true;
  ByteLevel model;
  VLA_TRY(model.pretokenizer, Pretokenizer::parse(pre));
  VLA_TRY(model.bpe, Bpe::create(tokens, merges, ignore_merges, is_added));
  model_ = std::move(model);
  return keys.has("tokenizer.prefix_ids") ? read_prefix(keys, tokens.size()) : Status();
}

Status Tokenizer::read_byte_fallback(const Keys& keys, const std::vector<std::string>& tokens) {
  VLA_TRY(const std::vector<std::string> merges, keys.strings("tokenizer.merges"));
  VLA_CHECK(read_prefix(keys, tokens.size()));
  VLA_TRY(model_, ByteFallbackBpe::create(tokens, merges));
  return {};
}

Status Tokenizer::read_prefix(const Keys& keys, std::size_t n_token) {
  VLA_TRY(prefix_, keys.integers("tokenizer.prefix_ids", {0, static_cast<double>(n_token) - 1.0}));
  if (prefix_.size() <= kMaxPrefix) return {};
  return Error{Code::bad_bundle, "tokenizer.prefix_ids", "at most " + std::to_string(kMaxPrefix) + " ids",
               std::to_string(prefix_.size())};
}

void Tokenizer::encode_piece(std::string_view piece, Ids& ids) const {
  if (const auto* fallback = std::get_if<ByteFallbackBpe>(&model_)) return fallback->encode(piece, ids);
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
  return ids;
}

}  // namespace vla
