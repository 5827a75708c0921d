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

/// What differs between the heads of the releases.
struct GrootFamily {
  bool state_rows;     // the state has `policy.n_state_row` rows, one per moment; each becomes a token
  bool future_tokens;  // `policy.n_future` learned tokens between the state and the actions
  bool mixing;         // `vl.n_layer` layers of self-attention over the context
  bool alternating;    // even layers attend to text or images in turn (`dit.attend_text_every_n_blocks`), else to both
                       // rows
  bool norm = true;    // `context` normalizes and mixes the features, else it returns them
  bool may_lack_state = false;  // `policy.d_state` may be 0: then there is no state token
};

/// The action head of GR00T: self-attention over the features, a diffusion transformer over tokens of state and
/// actions, and around it layers that each robot has of its own. Flow matching from noise (t = 0) to actions (t = 1).
/// Reads `vl.*`, `dit.*` and `policy.*`. Source: lerobot policies/groot/groot_n1_7.py GR00TN17ActionHead; before it
/// Isaac-GR00T gr00t/model/action_head/flow_matching_action_head.py (future tokens). VLA-JEPA's is the same, for one
/// robot: lerobot policies/vla_jepa/action_head.py VLAJEPAActionHead.
class GrootHead {
 public:
  /// `s` is the root of the tree; `d_context`: width of the features.
  GrootHead(const Scope& s, int d_context, GrootFamily family);

  /// Load rate: the modulations of all norms and the embedded time of the actions, one column per time.
  Tensor condition(Graph& g, std::span<const SolverTime> times) const;
  /// Observation rate: features [d_context, n] -> the same shape, normalized and mixed.
  Tensor context(Graph& g, Tensor features) const;
  /// Observation rate: caches keys and values of the context, and the tokens before those of the actions.
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
