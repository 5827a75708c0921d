// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/bin_tokens.h"

#include <fmt/format.h>

#include <algorithm>

#include "processor/recipe.h"

namespace vla {

Result<BinTokens> BinTokens::read(const Keys& keys) {
  BinTokens tokens;
  VLA_TRY(const int n_vocab, keys.integer("lm.n_vocab", {1, 1 << 24}));
  VLA_TRY(tokens.n_bin_, keys.integer("action_tokens.n_bin", {2, 1 << 16}));
  VLA_TRY(tokens.first_id_, keys.integer("action_tokens.first_id", {0, n_vocab - 1.0}));
  if (tokens.first_id_ < tokens.n_bin_ - 1)
    return misfit("action_tokens.n_bin",
                  fmt::format("at most {} bins below id {}", tokens.first_id_ + 1, tokens.first_id_),
                  std::to_string(tokens.n_bin_));
  return tokens;
}

Result<std::vector<float>> BinTokens::decode(std::span<const std::int32_t> ids, int horizon, int d_action,
                                             std::string* note) const {
  const auto n = static_cast<std::size_t>(horizon) * static_cast<std::size_t>(d_action);
  if (ids.size() < n)
    return Error{Code::bad_action, "action tokens", fmt::format("{}, one for each number", n),
                 std::to_string(ids.size()), "the policy stopped before"};
  std::vector<float> chunk;
  for (const std::int32_t id : ids.last(n)) {
    const int bin = first_id_ - id, nearest = std::clamp(bin, 0, n_bin_ - 2);
    if (bin < 0 || bin >= n_bin_)
      *note = fmt::format("action tokens: id {} is none of the {} actions; the nearest takes its place", id, n_bin_);
    const auto edge = [this](int i) { return -1.0 + 2.0 / (n_bin_ - 1) * i; };
    chunk.push_back(static_cast<float>((edge(nearest) + edge(nearest + 1)) / 2.0));
  }
  return chunk;
}

}  // namespace vla
