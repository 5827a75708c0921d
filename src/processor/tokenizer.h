// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <variant>
#include <vector>

#include "base/result.h"
#include "bundle/keys.h"
#include "processor/added_tokens.h"
#include "processor/bpe.h"
#include "processor/byte_fallback_bpe.h"
#include "processor/pretokenizer.h"
#include "processor/wordpiece.h"

namespace vla {

/// Text to token ids, equal to the Hugging Face `tokenizers` library (0.22) on every string. There are three kinds,
/// byte-level BPE, BPE with byte fallback and WordPiece; the keys that describe them are in docs/bundle.md. Nothing is
/// cut.
class Tokenizer {
 public:
  /// Longest text, in bytes. An instruction is a sentence; what is longer is a mistake or an attack.
  static constexpr std::size_t kMaxText = 64 * 1024;

  /// Reads and checks `tokenizer.*`; every id must be below `n_vocab`, the rows of the embedding. Errors: bad_bundle.
  static Result<Tokenizer> create(const Keys& keys, int n_vocab);

  /// Ids of `text`, which must be UTF-8 of at most `max_bytes` bytes, a prompt around an instruction being longer; NUL
  /// is a character like any other. The ids of `prefix()` and `suffix()` stand around. Errors: bad_observation, also
  /// for an added token that the embedding has no row for.
  Result<std::vector<std::int32_t>> encode(std::string_view text, std::size_t max_bytes = kMaxText) const;

  /// The ids in front of every text (`<bos>`), where the tokenizer puts some.
  const std::vector<std::int32_t>& prefix() const { return prefix_; }
  /// The ids behind every text (`[SEP]`).
  const std::vector<std::int32_t>& suffix() const { return suffix_; }

 private:
  struct ByteLevel {
    Pretokenizer pretokenizer;
    Bpe bpe;
  };

  using Ids = std::vector<std::int32_t>;

  Status read_byte_level(const Keys& keys, const std::vector<std::string>& tokens,
                         const std::vector<AddedToken>& added);
  Status read_byte_fallback(const Keys& keys, const std::vector<std::string>& tokens);
  Status read_wordpiece(const Keys& keys, const std::vector<std::string>& tokens, const std::vector<AddedToken>& added);
  void encode_piece(std::string_view piece, Ids& ids) const;

  AddedTokens added_;
  std::variant<ByteLevel, ByteFallbackBpe, WordPiece> model_;
  Ids prefix_, suffix_;
};

}  // namespace vla
