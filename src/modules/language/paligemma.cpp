// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/paligemma.h"

#include "nn/tokens.h"

namespace vla {

PaliGemma::PaliGemma(const Scope& s, DecoderOutput output)
    : vision_(s / "vision"),
      lm_(s / "lm", kGemma, output),
      projector_(s / "projector", vision_.d_model(), lm_.d_model(), Bias::yes),
      text_scale_(s.number("text_scale", kTokenScale)) {}

void PaliGemma::prefill(Graph& g, Tensor images, Tensor tokens, Cache& cache) const {
  const Tensor view = projector_(g, vision_(g, images));  // [d_model, n_token, n_view]
  g.end_stage("vision");
  const Tensor image = flatten_views(g, view);  // [d_model, n_token * n_view]
  lm_.prefill(g, g.name("prefix", concat_tokens(g, {image, embed(g, tokens)})), {}, cache);
}

Keys PaliGemma::published(std::map<std::string, Value, std::less<>> policy) {
  // clang-format off
  policy.insert({
      {"policy.text_scale", 45.254833995939045},
      {"vision.d_model", 1152}, {"vision.n_layer", 27}, {"vision.n_head", 16}, {"vision.d_ff", 4304},
      {"vision.image_size", 224}, {"vision.patch_size", 14}, {"vision.norm_eps", 1e-6},
      {"vision.position_rule", "row_major"},
      {"lm.d_model", 2048}, {"lm.n_layer", 18}, {"lm.n_head", 8}, {"lm.n_head_kv", 1}, {"lm.d_head", 256},
      {"lm.d_ff", 16384}, {"lm.n_vocab", 257152}, {"lm.norm_eps", 1e-6}, {"lm.rope_base", 10000.0}});
  // clang-format on
  return Keys(std::move(policy));
}

}  // namespace vla
