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

/// Token texts and their ids. The views point into the indexed list.
using TokenIds = std::unordered_map<std::string_view, std::int32_t>;

/// Errors: bad_bundle for an empty text, or one that two ids share.
Result<TokenIds> index_tokens(const std::vector<std::string>& tokens);

/// The merges of a byte-pair encoding, for any alphabet. Source: tokenizers models/bpe/model.rs and word.rs
/// (merge_all).
class Merges {
 public:
  /// `merges` as `left right` by rank. Errors: bad_bundle if a merge names an unknown token.
  static Result<Merges> create(const TokenIds& ids, const std::vector<std::string>& merges);

  /// Merges a word, given as the ids of its symbols, and appends the remaining ids. Takes O(n log n).
  void apply(const std::vector<std::int32_t>& symbols, std::vector<std::int32_t>& ids) const;

 private:
  struct Merge {
    std::int32_t right;
    std::int32_t rank;
    std::int32_t id;  // id of the merged token
  };

  const Merge* find(std::int32_t left, std::int32_t right) const;

  // Half a million merges are common. One array, sorted by left id, then right id, needs a quarter of a hash map's
  // memory. The merges of `left` are at rows_[left] up to rows_[left + 1].
  std::vector<std::uint32_t> rows_;
  std::vector<Merge> merges_;
};

}  // namespace vla
