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

/// FAST: a language model's tokens as the discrete cosine transform of a chunk. A token stands for some characters, a
/// character for a coefficient. Source: lerobot policies/pi0_fast/modeling_pi0_fast.py (detokenize_actions), tokenizers
/// decoders/byte_level.
class FastTokens {
 public:
  /// Reads `action_tokens.*`, `solver.stop_token` and `lm.n_vocab`. Errors: bad_bundle.
  static Result<FastTokens> read(const Keys& keys);

  /// The chunk (horizon, d_action), normalized, of the ids that the language model gave, in order. A chunk without all
  /// of its coefficients has zeros for the rest; `note` then says so. Errors: bad_action, for a sequence that does not
  /// begin as it must, and for an id that is none of the language model's.
  Result<std::vector<float>> decode(std::span<const std::int32_t> ids, int horizon, int d_action,
                                    std::string* note) const;

 private:
  Status check(std::span<const std::int32_t> ids) const;
  std::vector<std::int32_t> action_ids(std::span<const std::int32_t> ids) const;
  std::vector<double> coefficients(std::span<const std::int32_t> ids, std::string& note) const;

  std::vector<std::string> bytes_;  // that each of FAST's tokens stands for
  double min_token_ = 0, scale_ = 1;
  int first_id_ = 0;  // the language model's id of FAST's token 0; those of the others go down from here
  int stop_token_ = 0, n_vocab_ = 0;
  std::vector<int> prefix_;    // ids of the text in front of actions, left out wherever it stands
  std::vector<int> required_;  // ids that come first
};

}  // namespace vla
