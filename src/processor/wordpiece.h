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

/// BERT's tokenizer for text without capitals and accents: words are cut into the longest tokens of a vocabulary from
/// the left, of which those within a word begin with `##`. A word that cannot be cut is the unknown token as a whole,
/// and so is one of more than 100 characters. Sources: tokenizers normalizers/bert.rs, pre_tokenizers/bert.rs,
/// models/wordpiece/mod.rs.
class WordPiece {
 public:
  /// `tokens` by id; those of `is_added` are no words. Errors: bad_bundle when two ids share a text.
  static Result<WordPiece> create(const std::vector<std::string>& tokens, const std::vector<bool>& is_added,
                                  std::int32_t unknown);

  /// Valid UTF-8 without control characters, accents and capitals; Chinese characters stand alone.
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

  Pieces heads_, tails_;     // tokens that begin a word, and what follows the marks of the others
  std::size_t longest_ = 0;  // bytes of one of them
  std::int32_t unknown_ = 0;
};

}  // namespace vla
