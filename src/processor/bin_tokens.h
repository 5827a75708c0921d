// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "base/result.h"
#include "bundle/keys.h"

namespace vla {

/// One token for each number of a chunk; the token selects one of equal bins of [-1, 1]. Source: openvla
/// prismatic/extern/hf/modeling_prismatic.py (OpenVLAForActionPrediction.predict_action).
class BinTokens {
 public:
  /// Reads `action_tokens.n_bin` and `.first_id`, and `lm.n_vocab`. Errors: bad_bundle.
  static Result<BinTokens> read(const Keys& keys);

  /// Returns the centres of the bins. An id without a bin takes the nearest bin, as in the reference; `note` then says
  /// so. Errors: bad_action for fewer ids than numbers.
  Result<std::vector<float>> decode(std::span<const std::int32_t> ids, int horizon, int d_action,
                                    std::string* note) const;

 private:
  int n_bin_ = 0;     // number of action ids, one per edge; a bin lies between two edges
  int first_id_ = 0;  // id of the lowest bin; higher bins have lower ids
};

}  // namespace vla
