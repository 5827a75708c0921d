// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "base/result.h"
#include "bundle/keys.h"

namespace vla {

/// FAST: a language model's tokens encode the discrete cosine transform of a chunk. A token is a string of characters,
/// and each character is one coefficient. Source: lerobot policies/pi0_fast/modeling_pi0_fast.py (detokenize_actions),
/// tokenizers decoders/byte_level.
class FastTokens {
 public:
  /// Reads `action_tokens.*`, `solver.stop_token` and `lm.n_vocab`. Errors: bad_bundle.
  static Result<FastTokens> read(const Keys& keys);

  /// Decodes the ids of the language model's answer, in order, to a normalized chunk (horizon, d_action). Missing
  /// coefficients are zeros; `note` then says so. Errors: bad_action for a sequence that does not begin with the
  /// required ids, or an id outside the language model's vocabulary.
  Result<std::vector<float>> decode(std::span<const std::int32_t> ids, int horizon, int d_action,
                                    std::string* note) const;

 private:
  Status check(std::span<const std::int32_t> ids) const;
  std::vector<std::int32_t> action_ids(std::span<const std::int32_t> ids) const;
  std::vector<double> coefficients(std::span<const std::int32_t> ids, std::string& note) const;

  std::vector<std::string> bytes_;  // the bytes of each FAST token
  double min_token_ = 0, scale_ = 1;
  int first_id_ = 0;  // the language model's id of FAST token 0; token i has the id first_id_ - i
  int stop_token_ = 0, n_vocab_ = 0;
  std::vector<int> prefix_;    // ids of the text before the actions, removed wherever it occurs
  std::vector<int> required_;  // ids with which the answer must begin
};

}  // namespace vla
