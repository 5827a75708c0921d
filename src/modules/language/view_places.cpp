// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/view_places.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "nn/tokens.h"

namespace vla {

ViewPlaces::ViewPlaces(const Scope& s, int n_view_token, Count count)
    : n_view_token_(n_view_token),
      count_(count),
      counts_(s.integers(count == Count::from_end ? "view_starts_from_end" : "view_starts", kTokenIndex)) {
  const bool back = count_ == Count::from_end;
  bool apart = max_views() == s.dim("max_views", 32);
  for (const int n : counts_) apart = apart && n > 0;
  if (apart) {
    // The first token belongs to no view: text must have a token to attend to.
    min_tokens_ = back ? 1 + counts_.front() : counts_.back() + n_view_token_;
    int end = 1;
    for (const int start : starts(min_tokens_)) {
      apart = apart && start >= end;
      end = start + n_view_token_;
    }
    apart = apart && end <= min_tokens_;
  }
  s.require(apart, back ? "view_starts_from_end" : "view_starts",
            fmt::format("max_views places of {} tokens each, behind the first token", n_view_token_),
            fmt::format("{}", fmt::join(counts_, " ")));
}

std::vector<int> ViewPlaces::starts(int n_token) const {
  std::vector<int> starts = counts_;
  if (count_ == Count::from_end)
    for (int& start : starts) start = n_token - start;
  return starts;
}

Status ViewPlaces::check(int n_view, int n_token) const {
  if (n_view != max_views())
    return Error{Code::bad_bundle, "policy.max_views", fmt::format("{}, one for each view", n_view),
                 std::to_string(max_views())};
  if (n_token >= min_tokens_) return {};
  return Error{Code::bad_bundle, "processor.recipe.text", fmt::format("{} tokens or more, for the views", min_tokens_),
               std::to_string(n_token)};
}

std::vector<PromptPiece> ViewPlaces::pieces(int n_token) const {
  std::vector<PromptPiece> pieces;
  int at = 0;
  const auto text_until = [&](int end) {
    if (at < end) pieces.push_back({at, end - at, PromptPiece::kText});
    at = end;
  };
  int slot = 0;
  for (const int start : starts(n_token)) {
    text_until(start);
    pieces.push_back({start, n_view_token_, slot++});
    at = start + n_view_token_;
  }
  text_until(n_token);
  return pieces;
}

Tensor ViewPlaces::arrange(Graph& g, Tensor views, int n_token,
                           const std::function<Tensor(const PromptPiece&)>& text) const {
  std::vector<Tensor> parts;
  for (const PromptPiece& piece : pieces(n_token))
    parts.push_back(piece.slot == PromptPiece::kText ? text(piece) : one_view(g, views, piece.slot));
  return concat_tokens(g, parts);
}

ViewPlaces::Rows ViewPlaces::split(Graph& g, Tensor rows) const {
  std::vector<Tensor> image, text;
  for (const PromptPiece& piece : pieces(static_cast<int>(rows.dim(1))))
    (piece.slot == PromptPiece::kText ? text : image).push_back(slice_tokens(g, rows, piece.first, piece.count));
  return {concat_tokens(g, image), concat_tokens(g, text)};
}

}  // namespace vla
