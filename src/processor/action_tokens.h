// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <variant>

#include "processor/bin_tokens.h"
#include "processor/fast_tokens.h"

namespace vla {

/// Decodes the tokens of a language model's answer to a chunk.
class ActionTokens {
 public:
  /// Reads `action_tokens.kind` and the keys of that kind; nullopt if the bundle has no kind. Errors: bad_bundle.
  static Result<std::optional<ActionTokens>> read(const Keys& keys);

  /// Decodes the ids of the answer, in order, to a normalized chunk (horizon, d_action). If the ids do not exactly
  /// encode a chunk but can be read as one, `note` says how. Errors: bad_action.
  Result<std::vector<float>> decode(std::span<const std::int32_t> ids, int horizon, int d_action,
                                    std::string* note = nullptr) const;

 private:
  using Kind = std::variant<FastTokens, BinTokens>;
  explicit ActionTokens(Kind kind) : kind_(std::move(kind)) {}

  Kind kind_;
};

}  // namespace vla
