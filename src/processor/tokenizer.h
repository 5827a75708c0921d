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

/// Converts text to token ids, equal to the Hugging Face `tokenizers` library (0.22) on every string. Kinds: byte-level
/// BPE, BPE with byte fallback, WordPiece; docs/bundle.md has their keys. It does not truncate.
class Tokenizer {
 public:
  /// Longest text in bytes. An instruction is a sentence; a longer text is a mistake or an attack.
  static constexpr std::size_t kMaxText = 64 * 1024;

  /// Reads and checks `tokenizer.*`; every id must be below `n_vocab`, the embedding's rows. Errors: bad_bundle.
  static Result<Tokenizer> create(const Keys& keys, int n_vocab);

  /// Encodes `text`, which must be UTF-8 of at most `max_bytes` bytes (a prompt is longer than its instruction); NUL is
  /// an ordinary character. The result starts with `prefix()` and ends with `suffix()`. Errors: bad_observation, also
  /// for an added token without a row in the embedding.
  Result<std::vector<std::int32_t>> encode(std::string_view text, std::size_t max_bytes = kMaxText) const;

  /// The ids before every text (`<bos>`), or none.
  const std::vector<std::int32_t>& prefix() const { return prefix_; }
  /// The ids after every text (`[SEP]`), or none.
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
