// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "modules/language/decoder.h"
#include "modules/vision/siglip.h"
#include "nn/tokens.h"

namespace vla {

/// PaliGemma as the π family uses it: a SigLIP tower, a linear projector, and a Gemma that computes keys and values of
/// images and text. Reads `vision.*`, `projector.*`, `lm.*` and `policy.text_scale`. Source: lerobot
/// policies/pi0/modeling_pi0.py embed_prefix.
class PaliGemma {
 public:
  /// `s` is the root of the tree.
  explicit PaliGemma(const Scope& s, DecoderOutput output = DecoderOutput::keys_and_values);

  /// Checks that images have the tower's size. Errors: bad_bundle, unsupported.
  Status check(int width, int height) const { return vision_.check(width, height); }
  /// Tokens of one view.
  int n_token(int width) const { return (width / vision_.patch_size()) * (width / vision_.patch_size()); }
  /// images [width, height, 3, n_view], tokens [n_text] i32 -> cache `lm.blk.<i>.{k,v}` of n_view * n_token + n_text
  /// tokens with full attention. The reference masks absent views and padding, which do not advance positions, so
  /// leaving them out changes nothing. If the policy reads logits, also caches the `logits` of the first token.
  void prefill(Graph& g, Tensor images, Tensor tokens, Cache& cache) const;

  /// Decoder::next for the embedding of `token` [1] i32.
  Tensor next(Graph& g, Tensor token, Tensor k, int n_token, Cache& cache) const {
    return lm_.next(g, embed(g, token), k, n_token, cache);
  }

  const Decoder& lm() const { return lm_; }

  /// The keys of the published size, PaliGemma 3B at 224 pixels, added to a policy's own. Source: transformers
  /// PaliGemmaConfig, lerobot get_gemma_config.
  static Keys published(std::map<std::string, Value, std::less<>> policy);

 private:
  /// Scales only the embedded text: Gemma was trained with sqrt(d_model) on embeddings, the projector without it.
  Tensor embed(Graph& g, Tensor tokens) const { return scale(g, lm_.embed(g, tokens), text_scale_); }

  Siglip vision_;
  Decoder lm_;
  Linear projector_;
  float text_scale_;
};

}  // namespace vla
