// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/qwen3_vl.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>

#include "nn/attention.h"
#include "nn/tokens.h"

namespace vla {

std::vector<Place> prompt_places(std::span<const int> view_starts, int n_row, int n_column, int n_token) {
  std::vector<Place> places;
  int next = 0;
  const auto text_until = [&](int end) {
    for (; static_cast<int>(places.size()) < end; ++next) places.push_back({next, next, next});
  };
  for (const int start : view_starts) {
    text_until(start);
    for (int i = 0; i < n_row * n_column; ++i) places.push_back({next, next + i / n_column, next + i % n_column});
    next += std::max(n_row, n_column);
  }
  text_until(n_token);
  return places;
}

Qwen3Vl::Qwen3Vl(const Scope& s)
    : vision_(s / "vision"),
      lm_(s / "lm", QwenKind::qwen3),
      connector_(s / "connector", PatchMerger::Norm::patch, vision_.d_model(), vision_.n_merged(), lm_.d_model(),
                 vision_.norm_eps()),
      view_starts_(s.integers("view_starts", kTokenIndex)) {
  for (int k = 0; k < vision_.n_deepstack(); ++k)
    deepstack_.emplace_back(s / "deepstack" / k, PatchMerger::Norm::token, vision_.d_model(), vision_.n_merged(),
                            lm_.d_model(), vision_.norm_eps());
  (s / "vision")
      .require(vision_.n_deepstack() <= lm_.n_layer(), "deepstack_layers",
               fmt::format("at most lm.n_layer {}", lm_.n_layer()), std::to_string(vision_.n_deepstack()));

  const std::vector<int> sections = (s / "lm").integers("rope_sections", {0, 1 << 16});
  const int n_pair = lm_.heads().d_head / 2;
  const bool three =
      sections.size() == 3 && std::all_of(sections.begin(), sections.end(), [&](int n) { return n <= n_pair; });
  if (three) std::copy(sections.begin(), sections.end(), rope_sections_.begin());
  (s / "lm").require(
      three && sections[0] + sections[1] + sections[2] == n_pair && 3 * std::max(sections[1], sections[2]) <= n_pair,
      "rope_sections", fmt::format("three shares of {} pairs, at most a third for rows and columns", n_pair),
      fmt::format("{}", fmt::join(sections, " ")));

  int end = 1;  // text sees text: the first token is no picture's
  bool apart = static_cast<int>(view_starts_.size()) == s.dim("n_slot", 32);
  for (const int start : view_starts_) {
    apart = apart && start >= end;
    end = start + n_view_token();
  }
  s.require(apart, "view_starts",
            fmt::format("n_slot places of {} tokens each, behind the first token", n_view_token()),
            fmt::format("{}", fmt::join(view_starts_, " ")));
}

Status Qwen3Vl::check(int width, int height, int n_view, int n_token) const {
  VLA_CHECK(vision_.check(width, height));
  const int n_slot = static_cast<int>(view_starts_.size());
  if (n_view != n_slot)
    return Error{Code::bad_bundle, "policy.n_slot", fmt::format("{}, one for each view", n_view),
                 std::to_string(n_slot)};
  const int end = view_starts_.back() + n_view_token();
  if (n_token >= end) return {};
  return Error{Code::bad_bundle, "processor.recipe.text", fmt::format("{} tokens or more, where the views end", end),
               std::to_string(n_token)};
}

Tensor Qwen3Vl::operator()(Graph& g, Tensor images, Tensor tokens, const Cache& cache) const {
  const int n_token = static_cast<int>(tokens.dim(0));
  const std::vector<Tensor> seen = vision_(g, images, cache);
  std::vector<Tensor> added;
  for (std::size_t k = 0; k < deepstack_.size(); ++k) {
    added.push_back(arrange(g, deepstack_[k](g, seen[k]), n_token,
                            [&](Range range) { return filled(g, 0, lm_.d_model(), range.count); }));
    g.require(added.back());  // before the stage ends
  }
  const Tensor image = g.stage("vision", connector_(g, seen.back()));
  const Tensor x = arrange(g, image, n_token,
                           [&](Range range) { return lm_.embed(g, slice_ids(g, tokens, range.first, range.count)); });
  const Tensor rotary =
      interleaved_rotary_table(g, lm_.heads().d_head, lm_.heads().rope_base, rope_sections_,
                               prompt_places(view_starts_, vision_.n_token_row(), vision_.n_token_column(), n_token));
  return lm_(g, g.name("prefix", x), rotary, causal_mask(g, 0, n_token), added);
}

std::vector<Qwen3Vl::Range> Qwen3Vl::text_ranges(int n_token) const {
  std::vector<Range> ranges;
  int first = 0;
  for (const int start : view_starts_) {
    ranges.push_back({first, start - first});
    first = start + n_view_token();
  }
  ranges.push_back({first, n_token - first});
  return ranges;
}

Tensor Qwen3Vl::arrange(Graph& g, Tensor views, int n_token, const std::function<Tensor(Range)>& text) const {
  std::vector<Tensor> parts;
  int view = 0;
  for (const Range& range : text_ranges(n_token)) {
    if (range.count > 0) parts.push_back(text(range));
    if (view < static_cast<int>(view_starts_.size())) parts.push_back(one_view(g, views, view++));
  }
  return concat_tokens(g, parts);
}

Qwen3Vl::Rows Qwen3Vl::split(Graph& g, Tensor features) const {
  std::vector<Tensor> image, text;
  for (const int start : view_starts_) image.push_back(slice_tokens(g, features, start, n_view_token()));
  for (const Range& range : text_ranges(static_cast<int>(features.dim(1))))
    if (range.count > 0) text.push_back(slice_tokens(g, features, range.first, range.count));
  return {concat_tokens(g, image), concat_tokens(g, text)};
}

}  // namespace vla
