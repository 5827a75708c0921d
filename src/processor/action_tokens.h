// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <variant>

#include "processor/bin_tokens.h"
#include "processor/fast_tokens.h"

namespace vla {

/// How tokens that a language model answers with stand for a chunk.
class ActionTokens {
 public:
  /// Reads `action_tokens.kind` and what the kind reads; nullopt where a bundle has none. Errors: bad_bundle.
  static Result<std::optional<ActionTokens>> read(const Keys& keys);

  /// The chunk (horizon, d_action), normalized, of the ids that the language model gave, in order. `note` says where
  /// they stand for none as they are. Errors: bad_action.
  Result<std::vector<float>> decode(std::span<const std::int32_t> ids, int horizon, int d_action,
                                    std::string* note = nullptr) const;

 private:
  using Kind = std::variant<FastTokens, BinTokens>;
  explicit ActionTokens(Kind kind) : kind_(std::move(kind)) {}

  Kind kind_;
};

}  // namespace vla
