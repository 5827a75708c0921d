// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/tokenizer.h"

#include "processor/unicode.h"

namespace vla {
namespace {

Status check_kind(const Keys& keys) {
  VLA_TRY(const std::string kind, keys.string("tokenizer.kind"));
  if (kind == "byte_level_bpe") return {};
  return Error{Code::bad_bundle, "tokenizer.kind", "byte_level_bpe", kind, "this bundle needs a newer vla"};
}

/// The text of an added token stands at its id as well, so that a bundle's list of tokens is whole.
Status check_added(const std::vector<AddedToken>& added, const std::vector<std::string>& tokens, bool ignore_merges) {
  for (std::size_t i = 0; i < added.size(); ++i) {
    const std::string where = "tokenizer.added[" + std::to_string(i) + "]";
    const auto id = static_cast<std::size_t>(added[i].id);
    if (id >= tokens.size() || tokens[id] != added[i].content)
      return Error{Code::bad_bundle, where + ".content", "the text of tokenizer.tokens[" + std::to_string(id) + "]",
                   added[i].content};
    // A single word token that is passed over could come back as a whole word, and the bundle does not say whether the
    // model's own vocabulary has it.
    if (ignore_merges && added[i].single_word)
      return Error{Code::bad_bundle, where + ".single_word", "false, because tokenizer.ignore_merges is set", "true"};
  }
  return {};
}

}  // namespace

Result<Tokenizer> Tokenizer::create(const Keys& keys, int n_vocab) {
  VLA_CHECK(check_kind(keys));
  VLA_TRY(const std::vector<std::string> tokens, keys.strings("tokenizer.tokens"));
  VLA_TRY(const std::vector<std::string> merges, keys.strings("tokenizer.merges"));
  VLA_TRY(const std::string pre, keys.string("tokenizer.pre"));
  VLA_TRY(const std::string added_json, keys.string("tokenizer.added"));
  VLA_TRY(const bool ignore_merges, keys.boolean("tokenizer.ignore_merges"));
  if (n_vocab < 1 || tokens.size() > static_cast<std::size_t>(n_vocab))
    return Error{Code::bad_bundle, "tokenizer.tokens", "at most " + std::to_string(n_vocab) + " tokens (lm.n_vocab)",
                 std::to_string(tokens.size())};
  VLA_TRY(std::vector<AddedToken> added, parse_added_tokens(added_json, n_vocab));
  VLA_CHECK(check_added(added, tokens, ignore_merges));
  std::vector<bool> is_added(tokens.size());
  for (const AddedToken& token : added) is_added[static_cast<std::size_t>(token.id)] = true;

  Tokenizer tokenizer;
  VLA_TRY(tokenizer.pretokenizer_, Pretokenizer::parse(pre));
  VLA_TRY(tokenizer.bpe_, Bpe::create(tokens, merges, ignore_merges, is_added));
  tokenizer.added_ = AddedTokens(std::move(added));
  return tokenizer;
}

Result<std::vector<std::int32_t>> Tokenizer::encode(std::string_view text) const {
  if (text.size() > kMaxText)
    return Error{Code::bad_observation, "instruction", "at most " + std::to_string(kMaxText) + " bytes of text",
                 std::to_string(text.size()) + " bytes"};
  if (const std::size_t valid = unicode::valid_prefix(text); valid < text.size())
    return Error{Code::bad_observation, "instruction", "UTF-8 text",
                 "a byte that is not UTF-8 at offset " + std::to_string(valid)};
  std::vector<std::int32_t> ids;
  added_.split(
      text,
      [&](std::string_view piece) {
        pretokenizer_.split(piece, [&](std::string_view word) { bpe_.encode(word, ids); });
      },
      [&](std::int32_t id) { ids.push_back(id); });
  return ids;
}

}  // namespace vla
