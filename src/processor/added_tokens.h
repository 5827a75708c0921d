// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "base/result.h"

namespace vla {

/// The id of an added token without a row in the embedding. Text that contains it cannot be encoded.
inline constexpr std::int32_t kNoRow = -1;

/// A token that is cut out of the text before normalization and splitting, e.g. `<image>`.
struct AddedToken {
  std::int32_t id = 0;  // kNoRow: no row in the embedding
  std::string content;
  bool single_word = false;  // only between characters that are not word characters
  bool lstrip = false;       // includes the white space on its left
  bool rstrip = false;       // includes the white space on its right
  bool normalized = false;   // searched for after all others, in normalized text
};

/// Reads `tokenizer.added`. Errors: bad_bundle, also for ids from `n_vocab` on, and for repeated ids or contents.
Result<std::vector<AddedToken>> parse_added_tokens(const std::string& json, int n_vocab);

/// Finds added tokens in text: leftmost first, and the longest of those that start at the same place. Source:
/// tokenizers added_vocabulary.rs (extract_and_normalize, find_matches).
class AddedTokens {
 public:
  /// Normalizes text, and the contents of `normalized` tokens, before these tokens are searched for.
  using Normalize = std::string (*)(std::string_view);

  AddedTokens() = default;
  /// If `normalize` is null, text is not normalized.
  explicit AddedTokens(std::vector<AddedToken> tokens, Normalize normalize = nullptr);

  /// Calls `on_text` for each non-empty, normalized piece between added tokens and `on_token` for each token's id, in
  /// text order.
  void split(std::string_view text, const std::function<void(std::string_view)>& on_text,
             const std::function<void(std::int32_t)>& on_token) const;

 private:
  struct Node {
    std::vector<std::pair<std::uint8_t, int>> next;  // child nodes by byte
    int token = -1;                                  // index into tokens_ of the content that ends here
  };
  using Trie = std::vector<Node>;

  void insert(Trie& trie, std::string_view content, int token);
  struct Match {
    int token = -1;        // index into tokens_; -1: none
    std::size_t size = 0;  // bytes of the text
  };
  static Match longest_at(const Trie& trie, std::string_view text);
  void split(const Trie& trie, std::string_view text, const std::function<void(std::string_view)>& on_text,
             const std::function<void(std::int32_t)>& on_token) const;

  std::vector<AddedToken> tokens_;
  Normalize normalize_ = nullptr;
  Trie plain_{1};  // tokens that are not `normalized`
  Trie normalized_{1};
};

}  // namespace vla
