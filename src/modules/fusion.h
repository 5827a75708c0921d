// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "modules/detr.h"

namespace vla {

/// Two streams of tokens: images and text, [d_model, n] each.
struct Streams {
  Tensor image, text;
};

/// A layer in which each stream attends to the layer's input of the other stream and then passes an MLP. Source:
/// lerobot_policy_turbovla vl_interaction.py TurboVLAFusionLayer.
class FusionLayer {
 public:
  FusionLayer(const Scope& s, const DetrFamily& family) : image_(s / "image", family), text_(s / "text", family) {}
  Streams operator()(Graph& g, const Streams& x) const;

 private:
  /// One stream's part.
  class Side : public Module<Side> {
   public:
    Side(const Scope& s, const DetrFamily& family);
    Tensor norm(Graph& g, Tensor x) const { return attn_norm_(g, x); }
    /// `x`: this stream; `normed`, `other`: this and the other stream after their norms.
    Tensor forward(Graph& g, Tensor x, Tensor normed, Tensor other) const;

   private:
    LayerNorm attn_norm_;
    Attention attention_;
    NormedSum ffn_norm_;
    Mlp mlp_;
  };

  Side image_, text_;
};

}  // namespace vla
