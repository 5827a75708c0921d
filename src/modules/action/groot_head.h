// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>
#include <vector>

#include "modules/action/dit.h"
#include "modules/encoder_block.h"
#include "modules/timestep_embedding.h"
#include "nn/embedding.h"

namespace vla {

/// The options in which the heads of the GR00T releases differ.
struct GrootFamily {
  bool state_rows;              // the state has `policy.n_state_row` rows, one per moment; each becomes a token
  bool future_tokens;           // `policy.n_future` learned tokens between the state and the actions
  bool mixing;                  // `vl.n_layer` layers of self-attention over the context
  bool alternating;             // even layers alternate between text and images (`dit.attend_text_every_n_blocks`);
                                // otherwise they attend to both
  bool norm = true;             // features pass `vl.norm`; without it, do not call `context`
  bool may_lack_state = false;  // `policy.d_state` may be 0: then there is no state token
};

/// The action head of GR00T: self-attention over the features, a diffusion transformer over tokens of state and
/// actions, and before and after it layers with weights of each robot's own. Flow matching from noise (t = 0) to
/// actions (t = 1). Reads `vl.*`, `dit.*` and `policy.*`. Source: lerobot policies/groot/groot_n1_7.py
/// GR00TN17ActionHead; before it Isaac-GR00T gr00t/model/action_head/flow_matching_action_head.py (future tokens).
/// VLA-JEPA's is the same, for one robot: lerobot policies/vla_jepa/action_head.py VLAJEPAActionHead.
class GrootHead {
 public:
  /// `s` is the root of the tree; `d_context`: width of the features.
  GrootHead(const Scope& s, int d_context, GrootFamily family);

  /// Load rate: the modulations of all norms and the embedded time of the actions, one column per time.
  Tensor condition(Graph& g, std::span<const SolverTime> times) const;
  /// Observation rate: features [d_context, n] -> the same shape, normalized and mixed.
  Tensor context(Graph& g, Tensor features) const;
  /// Observation rate: caches keys and values of the context, and the tokens before the action tokens.
  void prepare(Graph& g, Tensor text, Tensor image, Tensor state, Cache& cache) const;
  /// Step rate: x_t [d_action, horizon] -> the velocity, the same shape. `condition` is one column of the load rate's
  /// table.
  Tensor velocity(Graph& g, Tensor x_t, Tensor condition, const Cache& cache) const;

 private:
  std::optional<LayerNorm> vl_norm_;  // observation rate
  std::vector<EncoderBlock> vl_blocks_;
  int d_state_, n_state_row_;
  std::optional<Linear> state_in_, state_out_;
  std::optional<Embedding> future_;
  int n_future_;
  Dit dit_;
  Linear action_in_, action_mix_, action_token_, decode_in_, decode_out_;  // step rate
  Embedding action_position_;
  int d_time_, n_bucket_, horizon_;
  Linear time_in_, time_out_;  // load rate
};

}  // namespace vla
