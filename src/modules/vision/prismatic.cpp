// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/prismatic.h"

#include "nn/tokens.h"

namespace vla {
namespace {

constexpr EncoderFamily kTimmSiglip = {Activation::gelu_erf, false};

}  // namespace

PrismaticVision::PrismaticVision(const Scope& s, int d_condition)
    : dino_(s / "dino", d_condition),
      siglip_(s / "siglip", kTimmSiglip, false, d_condition),
      d_patch_(dino_.d_model() + siglip_.d_model()),
      d_model_((s / "lm").dim("d_model")),
      projector_up_(s / "projector_up", d_patch_, 4 * d_patch_, Bias::yes),
      projector_mid_(s / "projector_mid", 4 * d_patch_, d_model_, Bias::yes),
      projector_down_(s / "projector_down", d_model_, d_model_, Bias::yes) {
  s.require(siglip_.n_position() == dino_.n_patch(), "siglip.image_size", "as many patches as dino has",
            std::to_string(siglip_.n_position()));
}

Status PrismaticVision::check(int width, int height, int n_text) const {
  VLA_CHECK(dino_.check(width, height));
  VLA_CHECK(siglip_.check(width, height));
  if (n_text >= 2) return {};
  return Error{Code::bad_observation, "instruction", "two tokens or more, the first before the image",
               std::to_string(n_text)};
}

Tensor PrismaticVision::operator()(Graph& g, Tensor images, Tensor condition) const {
  // Evaluated in two steps, because the order of function arguments, and so of the graph, depends on the compiler.
  const Tensor of_dino = dino_(g, images, condition), of_siglip = siglip_(g, images, condition);
  const Tensor patches = concat_features(g, of_dino, of_siglip);
  const Tensor hidden = activate(g, projector_up_(g, patches), Activation::gelu_erf);
  const Tensor mid = activate(g, projector_mid_(g, hidden), Activation::gelu_erf);
  const Tensor tokens = flatten_views(g, projector_down_(g, mid));
  g.end_stage("vision");
  return tokens;
}

Keys prismatic_published(std::map<std::string, Value, std::less<>> own) {
  // clang-format off
  own.insert({
      {"dino.d_model", 1024}, {"dino.n_layer", 23}, {"dino.n_head", 16}, {"dino.d_ff", 4096},
      {"dino.image_size", 224}, {"dino.patch_size", 14}, {"dino.n_register", 4}, {"dino.norm_eps", 1e-6},
      {"siglip.d_model", 1152}, {"siglip.n_layer", 26}, {"siglip.n_head", 16}, {"siglip.d_ff", 4304},
      {"siglip.image_size", 224}, {"siglip.patch_size", 14}, {"siglip.norm_eps", 1e-6},
      {"siglip.position_rule", "row_major"},
      {"lm.d_model", 4096}, {"lm.n_layer", 32}, {"lm.n_head", 32}, {"lm.n_head_kv", 32}, {"lm.d_head", 128},
      {"lm.d_ff", 11008}, {"lm.n_vocab", 32064}, {"lm.norm_eps", 1e-6}, {"lm.rope_base", 10000.0}});
  // clang-format on
  return Keys(std::move(own));
}

}  // namespace vla
