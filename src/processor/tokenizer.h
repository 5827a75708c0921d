// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "base/result.h"
#include "bundle/keys.h"
#include "processor/added_tokens.h"
#include "processor/bpe.h"
#include "processor/pretokenizer.h"

namespace vla {

/// Text to token ids by byte-level BPE, equal to the Hugging Face `tokenizers` library (0.22) on every string.
/// The keys that describe it are in docs/bundle.md. No ids are added at either end and nothing is cut.
class Tokenizer {
 public:
  /// Longest text, in bytes. An instruction is a sentence; what is longer is a mistake or an attack.
  static constexpr std::size_t kMaxText = 64 * 1024;

  /// Reads and checks `tokenizer.*`; every id must be below `n_vocab`, the rows of the embedding. Errors: bad_bundle.
  static Result<Tokenizer> create(const Keys& keys, int n_vocab);

  /// Ids of `text`, which must be UTF-8 of at most `kMaxText` bytes; NUL is a character like any other.
  /// Errors: bad_observation.
  Result<std::vector<std::int32_t>> encode(std::string_view text) const;

 private:
  AddedTokens added_;
  Pretokenizer pretokenizer_;
  Bpe bpe_;
};

}  // namespace vla
