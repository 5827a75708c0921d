// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "modules/fusion.h"
#include "nn/attention.h"
#include "nn/linear.h"
#include "nn/norm.h"

namespace vla {

/// Image and text attend to each other with one matrix of scores: one projection of a stream is its query and its key.
/// Each stream adds its attention output, scaled by a factor per feature. Source: TurboVLA
/// turbovla/models/components/fusion.py BiAttentionBlock, BiMultiHeadAttention.
class BiAttention {
 public:
  struct Family {
    int d_model, d_inner, n_head;  // d_inner: width of all heads together
    bool keeps_input;              // the residual is the layer's input, else the normalized input
    float norm_eps;

    /// Reads n_head, d_inner and residual of `s`.
    static Family read(const Scope& s, int d_model, float norm_eps);
  };

  BiAttention(const Scope& s, const Family& family)
      : family_(family), image_(s / "image", family), text_(s / "text", family) {}
  /// Image tokens attend to the first `n_seen` text tokens, text tokens to all image tokens.
  Streams operator()(Graph& g, const Streams& x, int n_seen) const;

 private:
  /// One stream's part.
  struct Side {
    Side(const Scope& s, const Family& family);
    /// Projects the normalized stream to keys and values. The keys serve as its queries, too.
    KeyValue project(Graph& g, Tensor normed, int n_head) const;
    /// Adds the attention output, [d_head, n_head, n], to x.
    Tensor add_to(Graph& g, Tensor x, Tensor attended) const;

    std::string path;
    LayerNorm norm;
    Linear score, value, out;
    const Param* scale;
  };

  Family family_;
  Side image_, text_;
};

}  // namespace vla
