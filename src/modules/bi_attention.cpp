// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/bi_attention.h"

#include <fmt/format.h>

#include "nn/adaptive_norm.h"

namespace vla {

BiAttention::Family BiAttention::Family::read(const Scope& s, int d_model, float norm_eps) {
  const Family family = {d_model, s.dim("d_inner"), s.dim("n_head", 1024),
                         s.choice("residual", {"normed", "plain"}) == 1, norm_eps};
  s.require(family.d_inner % family.n_head == 0, "n_head", fmt::format("a divisor of d_inner {}", family.d_inner),
            std::to_string(family.n_head));
  s.require(d_model % family.n_head == 0, "n_head", fmt::format("a divisor of d_model {}", d_model),
            std::to_string(family.n_head));
  return family;
}

BiAttention::Side::Side(const Scope& s, const Family& family)
    : path(s.path()),
      norm(s / "attn_norm", family.d_model, family.norm_eps),
      score(s / "attn_qk", family.d_model, family.d_inner, Bias::yes),
      value(s / "attn_v", family.d_model, family.d_inner, Bias::yes),
      out(s / "attn_out", family.d_inner, family.d_model, Bias::yes),
      scale((s / "attn_scale").vector("weight", family.d_model)) {}

KeyValue BiAttention::Side::project(Graph& g, Tensor normed, int n_head) const {
  const Tensor key = split_heads(g, score(g, normed), n_head);
  return {key, split_heads(g, value(g, normed), n_head)};
}

Tensor BiAttention::Side::add_to(Graph& g, Tensor x, Tensor attended) const {
  return g.name(path, gated_add(g, x, out(g, attended), g.parameter(scale)));
}

Streams BiAttention::operator()(Graph& g, const Streams& x, int n_seen) const {
  const Streams normed = {image_.norm(g, x.image), text_.norm(g, x.text)};
  const KeyValue image = image_.project(g, normed.image, family_.n_head);
  const KeyValue text = text_.project(g, normed.text, family_.n_head);
  const KeyValue first = {slice_keys(g, text.key, 0, n_seen), slice_keys(g, text.value, 0, n_seen)};
  const Tensor of_text = attention(g, image.key, {first}, {}), of_image = attention(g, text.key, {image}, {});
  const Streams& base = family_.keeps_input ? x : normed;
  const Tensor image_out = image_.add_to(g, base.image, of_text);
  return {image_out, text_.add_to(g, base.text, of_image)};
}

}  // namespace vla
