// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// TurboVLA as its authors published it: DINOv3 over the views and BERT over the sentences of the instruction, layers in
// which image and text attend to each other and the text to itself, and a decoder that turns one learned query per
// chunk row into an action. One pass. `turbovla` is a port by others, with another network. Reference:
// H-EmbodVis/TurboVLA turbovla/models (turbovla.py, text_encoder.py, vision_encoder.py, action_head.py),
// turbovla/text/bert.py.

#include <fmt/format.h>

#include <algorithm>
#include <numeric>

#include "modules/bi_attention.h"
#include "modules/language/bert.h"
#include "modules/vision/dinov3.h"
#include "nn/tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

/// skip(x) + down(gelu(up(norm(x)))), normalized. [d_in, n, ...] -> [d_out, n, ...]. Source: VisionProjection.
class SkipProjection : public Module<SkipProjection> {
 public:
  SkipProjection(const Scope& s, int d_in, int d_out, float eps)
      : Module(s),
        norm_(s / "norm", d_in, eps),
        up_(s / "up", d_in, s.dim("d_hidden"), Bias::yes),
        down_(s / "down", s.dim("d_hidden"), d_out, Bias::yes),
        skip_(s / "skip", d_in, d_out, Bias::no),
        out_norm_(s / "out_norm", d_out, eps) {}
  Tensor forward(Graph& g, Tensor x) const {
    const Tensor straight = skip_(g, x);
    return out_norm_(g, add(g, straight, down_(g, activate(g, up_(g, norm_(g, x)), Activation::gelu_erf))));
  }

 private:
  LayerNorm norm_;
  Linear up_, down_, skip_;
  LayerNorm out_norm_;
};

/// The state as several tokens, each with a learned position: [d_state, 1] -> [d_model, n_token]. Source:
/// StateProjection.
class StateTokens : public Module<StateTokens> {
 public:
  StateTokens(const Scope& s, int d_state, int d_model, float eps)
      : Module(s),
        d_model_(d_model),
        n_token_(s.dim("n_token", 1024)),
        norm_(s / "norm", d_state, eps),
        up_(s / "up", d_state, s.dim("d_hidden"), Bias::yes),
        down_(s / "down", s.dim("d_hidden"), n_token_ * d_model, Bias::yes),
        place_(s / "place", d_model, n_token_),
        out_norm_(s / "out_norm", d_model, eps) {}
  Tensor forward(Graph& g, Tensor state) const {
    const Tensor wide = down_(g, activate(g, up_(g, norm_(g, state)), Activation::gelu_erf));
    return out_norm_(g, add(g, reshape_width(g, wide, d_model_), place_(g, arange(g, n_token_))));
  }
  int n_token() const { return n_token_; }

 private:
  int d_model_, n_token_;
  LayerNorm norm_;
  Linear up_, down_;
  Embedding place_;
  LayerNorm out_norm_;
};

class TurboVlaAuthors final : public Policy {
  /// Rows after the text. kept: every layer computes them. zeroed_first: zeros before the first layer. zeroed: zeros
  /// after every layer, too.
  enum class Padding { kept, zeroed_first, zeroed };

  int horizon_, n_view_, n_row_;  // n_row: text rows in the layers; 0: the number of tokens
  bool apart_, patch_places_;
  Padding padding_;
  std::vector<int> sentence_ends_;  // ids of the tokens that end a sentence
  int text_end_;
  DetrFamily family_;
  DinoV3 vision_;  // observation rate
  Bert lm_;
  SkipProjection projector_;
  Linear text_in_;
  Embedding camera_;
  std::optional<Embedding> place_;
  const Param* place_scale_ = nullptr;  // one factor per view
  StateTokens state_in_;
  std::vector<BiAttention> fusion_;
  std::vector<DetrEncoderLayer> text_layers_;
  Embedding query_;  // step rate
  DetrDecoder decoder_;
  Linear action_in_, action_mid_, action_out_;

 public:
  static Keys published();

  explicit TurboVlaAuthors(const Scope& s)
      : horizon_(s.dim("horizon", 4096)),
        n_view_(s.dim("n_view", 32)),
        n_row_(s.index("n_row", 1 << 16)),
        apart_(s.choice("sentences", {"together", "apart"}) == 1),
        patch_places_(s.choice("places", {"views", "patches"}) == 1),
        padding_(static_cast<Padding>(s.choice("padding", {"kept", "zeroed_first", "zeroed"}))),
        sentence_ends_(s.integers("sentence_ends", {0, (s / "lm").dim("n_vocab", 1 << 24) - 1.0})),
        text_end_(s.index("text_end", (s / "lm").dim("n_vocab", 1 << 24))),
        family_(DetrFamily::read(s / "transformer")),
        vision_(s / "vision", s.choice("vision_tokens", {"last_block", "normed"}) == 1),
        lm_(s / "lm"),
        projector_(s / "projector", vision_.d_model(), family_.d_model, family_.norm_eps),
        text_in_(s / "text_in", lm_.d_model(), family_.d_model, Bias::yes),
        camera_(s / "camera", family_.d_model, n_view_),
        state_in_(s / "state_in", s.dim("d_state"), family_.d_model, family_.norm_eps),
        query_(s / "query", family_.d_model, horizon_),
        action_in_(s / "action_in", family_.d_model, s.dim("d_hidden"), Bias::yes),
        action_mid_(s / "action_mid", s.dim("d_hidden"), s.dim("d_hidden"), Bias::yes),
        action_out_(s / "action_out", s.dim("d_hidden"), s.dim("d_action"), Bias::yes) {
    (s / "transformer").require(family_.pre_norm, "norm", "before", "after");
    if (patch_places_) {
      place_.emplace(s / "place", family_.d_model, n_view_ * vision_.n_patch());
      place_scale_ = (s / "place_scale").vector("weight", n_view_);
    }
    const Scope fusion = s / "fusion";
    const auto both = BiAttention::Family::read(fusion, family_.d_model, family_.norm_eps);
    const DetrFamily text = {family_.d_model, both.n_head, both.d_inner, family_.activation, false, family_.norm_eps};
    const int n_fusion = fusion.n_layer("n_layer"), n_decoder = (s / "decoder").n_layer("n_layer");
    for (int i = 0; i < n_fusion; ++i) {
      fusion_.emplace_back(fusion / "blk" / i, both);
      text_layers_.emplace_back(fusion / "blk" / i / "among", text);
    }
    decoder_ = DetrDecoder(s / "decoder", family_, n_decoder);
  }

  Status check(const InputShape& shape) const override {
    VLA_CHECK(vision_.check(shape.width, shape.height));
    VLA_CHECK(lm_.check(shape.n_text));
    if (shape.n_view != n_view_)
      return Error{Code::bad_bundle, "policy.n_view", std::to_string(shape.n_view), std::to_string(n_view_)};
    const int n_row = n_row_ > 0 ? n_row_ : shape.n_text;
    if (shape.n_text < 1 || shape.n_text > n_row)
      return Error{Code::bad_bundle, "processor.recipe.text", fmt::format("1 to {} tokens (policy.n_row)", n_row_),
                   std::to_string(shape.n_text)};
    if (!shape.text.sentences.empty() && !fits(shape.text, shape.n_text))
      return Error{Code::bad_observation, "instruction", fmt::format("sentences of {} tokens together", shape.n_text),
                   "others"};
    return check_prefix(shape.n_view, vision_.n_patch(), n_row + state_in_.n_token());
  }

  /// A sentence is the tokens up to and including an end token; they attend to each other. The first and the last
  /// token, and tokens that no end token follows, attend to themselves only. Tokens after the last text_end are
  /// padding. Source: generate_masks_with_special_tokens.
  TextLayout text_layout(std::span<const std::int32_t> tokens) const override {
    const int n = static_cast<int>(tokens.size());
    TextLayout layout = {.n_seen = n, .sentences = {}};
    int n_done = 0;  // tokens assigned to a sentence
    const auto alone_up_to = [&](int end) {
      layout.sentences.insert(layout.sentences.end(), static_cast<std::size_t>(end - n_done), 1);
      n_done = end;
    };
    for (int i = 0; i < n; ++i) {
      const int id = tokens[static_cast<std::size_t>(i)];
      if (id == text_end_) layout.n_seen = i + 1;
      if (i == 0) alone_up_to(1);
      if (i == 0 || i == n - 1 || std::ranges::find(sentence_ends_, id) == sentence_ends_.end()) continue;
      layout.sentences.push_back(i + 1 - n_done);
      n_done = i + 1;
    }
    alone_up_to(n);
    return layout;
  }

  /// Computes the queries' self-attention of the first layer, and the position embeddings of all patches.
  void constants(Graph& g, const std::function<Tensor()>& /*absent_view*/, Cache& cache) const override {
    decoder_.constants(g, query_(g, arange(g, horizon_)), {}, cache);
    if (!place_) return;
    const std::int64_t d = family_.d_model, n_patch = vision_.n_patch();
    const Tensor table = (*place_)(g, arange(g, static_cast<int>(n_view_ * n_patch)));
    const Tensor of_views = g.add(op::Reshape{}, {table}, {d * n_patch, n_view_, 1, 1});
    const Tensor scales = g.add(op::Reshape{}, {g.parameter(place_scale_)}, {1, n_view_, 1, 1});
    cache.put(g, "places", g.add(op::Reshape{}, {multiply(g, of_views, scales)}, {d, n_patch, n_view_, 1}));
  }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    Tensor image = projector_(g, vision_(g, in.images));  // [d_model, n_patch, n_view]
    g.end_stage("vision");
    const int n_text = static_cast<int>(in.tokens.dim(0));
    const TextLayout layout = in.text.sentences.empty() ? TextLayout{n_text, {n_text}} : in.text;
    if (place_) image = add(g, image, cache.get(g, "places"));
    const Tensor views = camera_(g, arange(g, n_view_));
    image = add(g, image, g.add(op::Reshape{}, {views}, {views.dim(0), 1, views.dim(1), 1}));
    Streams x = {flatten_views(g, image), text_rows(g, in.tokens, layout)};
    const int n_row = static_cast<int>(x.text.dim(1));
    if (padding_ != Padding::kept) x.text = without_padding(g, x.text, layout.n_seen);
    const Tensor mask = sentence_mask(g, layout, n_row);
    for (std::size_t i = 0; i < fusion_.size(); ++i) {
      x = fusion_[i](g, x, layout.n_seen);
      x.text = text_layers_[i](g, x.text, Tensor(), mask);
      if (padding_ == Padding::zeroed) x.text = without_padding(g, x.text, layout.n_seen);
    }
    const Tensor memory = g.name("prefix", concat_tokens(g, {x.image, x.text, state_in_(g, in.state)}));
    decoder_.prefix(g, memory, {}, cache);
  }

  Tensor velocity(Graph& g, Tensor /*x_t*/, Tensor /*condition*/, const Cache& cache) const override {
    Tensor x = activate(g, action_in_(g, decoder_(g, {}, cache)), Activation::relu);
    x = activate(g, action_mid_(g, x), Activation::relu);
    return tanh_of(g, action_out_(g, x));  // [d_action, horizon]
  }

 private:
  /// BERT's output, padded with zeros to n_row rows and projected: [d_model, n_row].
  Tensor text_rows(Graph& g, Tensor tokens, const TextLayout& layout) const {
    const int n = static_cast<int>(tokens.dim(0));
    Tensor hidden;
    if (apart_) {
      std::vector<std::int32_t> positions;
      for (const int size : layout.sentences)
        for (int i = 0; i < size; ++i) positions.push_back(i);
      hidden = lm_(g, tokens, constant_ids(g, "positions", positions), apart_mask(g, layout.sentences));
    } else {
      hidden = lm_(g, tokens, arange(g, n), first_mask(g, layout.n_seen, n, n));
    }
    if (n_row_ > n) hidden = concat_tokens(g, {hidden, full(g, 0, hidden.dim(0), n_row_ - n)});
    return text_in_(g, hidden);
  }

  static bool fits(const TextLayout& text, int n_text) {
    const auto& [n_seen, sizes] = text;
    return std::ranges::min(sizes) > 0 && std::accumulate(sizes.begin(), sizes.end(), std::int64_t{0}) == n_text &&
           n_seen > 0 && n_seen <= n_text;
  }

  /// Rows after the tokens attend to themselves only.
  static Tensor sentence_mask(Graph& g, const TextLayout& layout, int n_row) {
    std::vector<int> sizes = layout.sentences;
    const int n = std::accumulate(sizes.begin(), sizes.end(), 0);
    sizes.insert(sizes.end(), static_cast<std::size_t>(n_row - n), 1);
    return apart_mask(g, sizes);
  }

  static Tensor without_padding(Graph& g, Tensor text, int n_seen) {
    const std::int64_t n = text.dim(1);
    if (n_seen == n) return text;
    return concat_tokens(g, {slice_tokens(g, text, 0, n_seen), full(g, 0, text.dim(0), n - n_seen)});
  }
};

/// The size of the LIBERO checkpoints: two cameras, 0.2 B parameters. Sources: H-EmbodVis/TurboVLA
/// turbovla/training/trainer.py (parse_args), turbovla/models/configuration.py, and the configs of
/// facebook/dinov3-vitb16-pretrain-lvd1689m and google-bert/bert-base-uncased.
Keys TurboVlaAuthors::published() {
  // clang-format off
  return Keys({
      {"policy.d_state", 8}, {"policy.d_action", 7}, {"policy.horizon", 12}, {"policy.n_view", 2},
      {"policy.n_row", 21}, {"policy.sentences", "apart"}, {"policy.places", "views"}, {"policy.padding", "kept"},
      {"policy.vision_tokens", "normed"},
      {"policy.sentence_ends", std::vector<std::int64_t>{101, 102, 1012, 1029}}, {"policy.text_end", 102},
      {"policy.d_hidden", 512},
      {"vision.d_model", 768}, {"vision.n_layer", 12}, {"vision.n_head", 12}, {"vision.d_ff", 3072},
      {"vision.image_size", 256}, {"vision.patch_size", 16}, {"vision.norm_eps", 1e-5}, {"vision.rope_base", 100.0},
      {"vision.n_register", 4},
      {"lm.d_model", 768}, {"lm.n_layer", 12}, {"lm.n_head", 12}, {"lm.d_ff", 3072}, {"lm.n_vocab", 30522},
      {"lm.n_position", 512}, {"lm.norm_eps", 1e-12},
      {"projector.d_hidden", 1024}, {"state_in.n_token", 2}, {"state_in.d_hidden", 256},
      {"transformer.d_model", 256}, {"transformer.n_head", 8}, {"transformer.d_ff", 2048},
      {"transformer.activation", "relu"}, {"transformer.norm", "before"}, {"transformer.norm_eps", 1e-5},
      {"fusion.n_layer", 6}, {"fusion.n_head", 4}, {"fusion.d_inner", 1024}, {"fusion.residual", "normed"},
      {"decoder.n_layer", 3},
      {"solver.kind", "direct"}, {"solver.steps", 1}, {"solver.noise", "none"}});
  // clang-format on
}

}  // namespace

PolicyEntry turbovla_authors_policy() { return policy_entry<TurboVlaAuthors>("turbovla_authors"); }

}  // namespace vla
