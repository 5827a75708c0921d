// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "modules/fusion.h"
#include "nn/attention.h"
#include "nn/linear.h"
#include "nn/norm.h"

namespace vla {

/// Two streams attend to each other by one table of scores: what an image token asks the text with is its key where the
/// text asks. Every stream adds what it saw, scaled feature by feature. Source: TurboVLA
/// turbovla/models/components/fusion.py BiAttentionBlock, BiMultiHeadAttention.
class BiAttention {
 public:
  struct Family {
    int d_model, d_inner, n_head;  // d_inner: width of all heads together
    bool keeps_input;              // what was seen is added to the layer's input, else to its norm
    float norm_eps;

    /// Reads n_head, d_inner and residual of `s`.
    static Family read(const Scope& s, int d_model, float norm_eps);
  };

  BiAttention(const Scope& s, const Family& family)
      : family_(family), image_(s / "image", family), text_(s / "text", family) {}
  /// Image tokens see the first `n_seen` text tokens; text tokens see all image tokens.
  Streams operator()(Graph& g, const Streams& x, int n_seen) const;

 private:
  /// One stream's part.
  struct Side {
    Side(const Scope& s, const Family& family);
    /// What tokens ask with and are found by, and what they tell: the norm of the stream through two projections.
    KeyValue told(Graph& g, Tensor normed, int n_head) const;
    /// `seen`: heads of what the stream saw.
    Tensor add_to(Graph& g, Tensor x, Tensor seen) const;

    std::string path;
    LayerNorm norm;
    Linear score, value, out;
    const Param* scale;
  };

  Family family_;
  Side image_, text_;
};

}  // namespace vla
