// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/action_tokens.h"

#include "processor/recipe.h"

namespace vla {

Result<std::optional<ActionTokens>> ActionTokens::read(const Keys& keys) {
  constexpr const char* kKind = "action_tokens.kind";
  if (!keys.has(kKind)) return std::optional<ActionTokens>();
  const Result<std::string> kind = keys.string(kKind);
  if (!kind) return kind.error();
  if (*kind == "fast") {
    VLA_TRY(FastTokens tokens, FastTokens::read(keys));
    return std::optional(ActionTokens(std::move(tokens)));
  }
  if (*kind != "bins") return misfit(kKind, "fast or bins", *kind);
  VLA_TRY(BinTokens tokens, BinTokens::read(keys));
  return std::optional(ActionTokens(tokens));
}

Result<std::vector<float>> ActionTokens::decode(std::span<const std::int32_t> ids, int horizon, int d_action,
                                                std::string* note) const {
  std::string unread;
  const auto decoded = [&](const auto& tokens) {
    return tokens.decode(ids, horizon, d_action, note != nullptr ? note : &unread);
  };
  return std::visit(decoded, kind_);
}

}  // namespace vla
