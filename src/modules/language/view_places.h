// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <vector>

#include "bundle/params.h"
#include "graph/graph.h"

namespace vla {

/// A piece of a prompt: text, or the image tokens of one view.
struct PromptPiece {
  static constexpr int kText = -1;
  int first, count;
  int slot;  // the view's number, or kText
};

/// The places of the views among a prompt's tokens: `policy.max_views` of them, in order. If the instruction follows
/// the views, `policy.view_starts` counts from the first token; if it precedes them, `policy.view_starts_from_end`
/// counts back from the end.
class ViewPlaces {
 public:
  enum class Count { from_start, from_end };
  /// `s` is the root of the tree; `n_view_token`: image tokens of a view.
  ViewPlaces(const Scope& s, int n_view_token, Count count = Count::from_start);

  /// Checks that a prompt of `n_token` tokens has a place for each of `n_view` views and no other. Errors: bad_bundle.
  Status check(int n_view, int n_token) const;
  /// Text and views in the prompt's order; no piece is empty.
  std::vector<PromptPiece> pieces(int n_token) const;

  /// Inserts views [d, n_view_token, max_views] at their places between the rows [d, count] that `text` returns: [d,
  /// n_token].
  Tensor arrange(Graph& g, Tensor views, int n_token, const std::function<Tensor(const PromptPiece&)>& text) const;
  /// Splits rows [d, n_token] into the rows of the views and all other rows.
  struct Rows {
    Tensor image, text;
  };
  Rows split(Graph& g, Tensor rows) const;

  int max_views() const { return static_cast<int>(counts_.size()); }
  int n_view_token() const { return n_view_token_; }
  /// Index of the first token of every view.
  std::vector<int> starts(int n_token) const;
  /// Tokens of the shortest prompt.
  int min_tokens() const { return min_tokens_; }

 private:
  int n_view_token_, min_tokens_ = 1;
  Count count_;
  std::vector<int> counts_;  // the numbers in the key, not yet converted to starts
};

}  // namespace vla
