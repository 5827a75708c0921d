// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/bart.h"

#include <fmt/format.h>

namespace vla {

BartEncoder::BartEncoder(const Scope& s)
    : family_({s.dim("d_model"), s.dim("n_head", 1024), s.dim("d_ff"), Activation::gelu_erf, false,
               s.number("norm_eps", kNormEps)}),
      n_position_(s.dim("n_position")),
      token_(s / "token_embd", family_.d_model, s.dim("n_vocab", 1 << 24)),
      position_(s / "position", family_.d_model, n_position_),
      norm_(s / "embd_norm", family_.d_model, family_.norm_eps) {
  s.require(family_.d_model % family_.n_head == 0, "n_head", fmt::format("a divisor of d_model {}", family_.d_model),
            std::to_string(family_.n_head));
  const int n_layer = s.n_layer("n_layer");
  for (int i = 0; i < n_layer; ++i) layers_.emplace_back(s / "blk" / i, family_);
}

Status BartEncoder::check(int n_token) const {
  if (n_token <= n_position_) return {};
  return Error{Code::bad_bundle, "lm.n_position", fmt::format("{} or more, one for each token", n_token),
               std::to_string(n_position_)};
}

Tensor BartEncoder::operator()(Graph& g, Tensor x, Tensor positions, Tensor mask) const {
  x = norm_(g, add(g, x, position_(g, positions)));
  for (const DetrEncoderLayer& layer : layers_) x = layer(g, x, Tensor(), mask);
  return x;
}

}  // namespace vla
