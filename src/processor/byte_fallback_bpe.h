// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <string_view>
#include <unordered_map>
#include <vector>

#include "base/result.h"
#include "processor/merges.h"

namespace vla {

/// SentencePiece-style byte-pair encoding. Symbols are characters; spaces are written as U+2581 and join words; a
/// character without a token becomes the tokens `<0x00>` to `<0xFF>` of its bytes. Source: tokenizers
/// models/bpe/model.rs (merge_word, byte_fallback).
class ByteFallbackBpe {
 public:
  /// `tokens` by id, `merges` as `left right` by rank. Errors: bad_bundle if a byte has neither its own token nor (like
  /// Gemma's tab) a token of its character, two ids share a text, or a merge names an unknown token.
  static Result<ByteFallbackBpe> create(const std::vector<std::string>& tokens, const std::vector<std::string>& merges);

  /// `text` with every space written as U+2581.
  static std::string mark_blanks(std::string_view text);
  /// The same with a U+2581 in front, unless there is no text.
  static std::string mark_blanks_and_first(std::string_view text);

  /// Appends the ids of valid UTF-8 with marked spaces. The whole piece is one word.
  void encode(std::string_view piece, std::vector<std::int32_t>& ids) const;

 private:
  std::array<std::int32_t, 256> byte_ids_{};
  std::unordered_map<std::uint32_t, std::int32_t> char_ids_;  // by code point
  Merges merges_;
};

}  // namespace vla
