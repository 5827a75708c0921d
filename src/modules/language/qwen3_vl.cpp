// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/qwen3_vl.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>

#include "nn/attention.h"
#include "nn/tokens.h"

namespace vla {

std::vector<PositionId> mrope_position_ids(std::span<const int> view_starts, int n_row, int n_column, int n_token) {
  std::vector<PositionId> places;
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
      lm_(s / "lm", kQwen3Inner),
      connector_(s / "connector", PatchMerger::Norm::patch, vision_.d_model(), vision_.n_merged(), lm_.d_model(),
                 vision_.norm_eps()),
      places_(s, vision_.n_token_row() * vision_.n_token_column()) {
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
}

Status Qwen3Vl::check(int width, int height, int n_view, int n_token) const {
  VLA_CHECK(vision_.check(width, height));
  return places_.check(n_view, n_token);
}

Tensor Qwen3Vl::operator()(Graph& g, Tensor images, Tensor tokens, const Cache& cache) const {
  const int n_token = static_cast<int>(tokens.dim(0));
  const std::vector<Tensor> seen = vision_(g, images, cache);
  std::vector<Tensor> added;
  for (std::size_t k = 0; k < deepstack_.size(); ++k) {
    added.push_back(places_.arrange(g, deepstack_[k](g, seen[k]), n_token,
                                    [&](const PromptPiece& piece) { return full(g, 0, lm_.d_model(), piece.count); }));
  }
  const Tensor image = connector_(g, seen.back());
  g.end_stage("vision");
  const Tensor x = lm_.embed(g, tokens, image, places_);
  const Tensor rotary = mrope_table(
      g, lm_.heads().d_head, lm_.heads().rope_base, rope_sections_,
      mrope_position_ids(places_.starts(n_token), vision_.n_token_row(), vision_.n_token_column(), n_token));
  return lm_(g, g.name("prefix", x), rotary, causal_mask(g, 0, n_token), added);
}

}  // namespace vla
