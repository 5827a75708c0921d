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

/// The byte that a character of the byte-level alphabet encodes (U+0100 is byte 0, `Ġ` is a space, printable ASCII is
/// itself); -1 for other characters.
int byte_of_symbol(std::uint32_t code_point);

/// The bytes that a token of this alphabet encodes; the token's own text if a character is not in the alphabet.
std::string bytes_of_token(const std::string& text);

/// Byte-level byte-pair encoding of one word, whose symbols are bytes. Source: tokenizers models/bpe/model.rs.
class Bpe {
 public:
  /// `tokens` by id, `merges` as `left right` by rank, both in the byte-level alphabet. With `ignore_merges` a word
  /// that is a whole token becomes that token, unless the token `is_added` (by id). Errors: bad_bundle if a byte has no
  /// token, two ids share a text, or a merge names an unknown token.
  static Result<Bpe> create(const std::vector<std::string>& tokens, const std::vector<std::string>& merges,
                            bool ignore_merges, const std::vector<bool>& is_added);

  /// Appends the ids of one word, given as raw bytes. Takes O(n log n) for n bytes.
  void encode(std::string_view word, std::vector<std::int32_t>& ids) const;

 private:
  std::array<std::int32_t, 256> byte_ids_{};
  Merges merges_;
  std::unordered_map<std::string, std::int32_t> whole_words_;  // raw bytes to id; empty without ignore_merges
};

}  // namespace vla
