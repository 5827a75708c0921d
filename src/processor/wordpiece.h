// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <unordered_map>
#include <vector>

#include "base/result.h"

namespace vla {

/// BERT's tokenizer for uncased text: words are split into the vocabulary's longest tokens from the left; tokens inside
/// a word begin with `##`. A word that cannot be split, or has more than 100 characters, becomes the unknown token.
/// Sources: tokenizers normalizers/bert.rs, pre_tokenizers/bert.rs, models/wordpiece/mod.rs.
class WordPiece {
 public:
  /// `tokens` by id; those that `is_added` are not words. Errors: bad_bundle if two ids share a text.
  static Result<WordPiece> create(const std::vector<std::string>& tokens, const std::vector<bool>& is_added,
                                  std::int32_t unknown);

  /// Removes control characters, accents and capitals from valid UTF-8, and separates Chinese characters.
  static std::string normalize(std::string_view text);

  /// Appends the ids of normalized text.
  void encode(std::string_view text, std::vector<std::int32_t>& ids) const;

 private:
  struct Hash {
    using is_transparent = void;
    std::size_t operator()(std::string_view text) const { return std::hash<std::string_view>{}(text); }
  };
  using Pieces = std::unordered_map<std::string, std::int32_t, Hash, std::equal_to<>>;

  void encode_word(std::string_view word, std::vector<std::int32_t>& ids) const;

  Pieces heads_, tails_;     // tokens that begin a word; tokens inside a word, without `##`
  std::size_t longest_ = 0;  // length of the longest token, in bytes
  std::int32_t unknown_ = 0;
};

}  // namespace vla
