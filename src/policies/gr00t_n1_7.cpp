// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// GR00T N1.7: Qwen3-VL prefix whose features are read before the final norm, self-attention over them, a diffusion
// transformer that looks at text and images in turn, flow matching from noise (t = 0) to actions (t = 1). Reference:
// lerobot src/lerobot/policies/groot (groot_n1_7.py GR00TN17ActionHead, action_head/cross_attention_dit.py).

#include <fmt/format.h>

#include "modules/action/dit.h"
#include "modules/language/qwen3_vl.h"
#include "modules/time_embedding.h"
#include "nn/tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

class Gr00tN17 final : public Policy {
  Qwen3Vl backbone_;  // observation rate
  LayerNorm vl_norm_;
  std::vector<EncoderBlock> vl_blocks_;
  Linear state_in_, state_out_;
  Dit dit_;
  Linear action_in_, action_mix_, action_token_, decode_in_, decode_out_;  // step rate
  Embedding action_position_;
  int d_time_, n_bucket_, horizon_;
  Linear time_in_, time_out_;  // load rate

 public:
  explicit Gr00tN17(const Scope& s)
      : backbone_(s),
        vl_norm_(s / "vl" / "norm", backbone_.d_model(), (s / "vl").number("norm_eps", kNormEps)),
        state_in_(s / "state_in", s.dim("d_state"), (s / "dit").dim("d_hidden"), Bias::yes),
        state_out_(s / "state_out", (s / "dit").dim("d_hidden"), (s / "dit").dim("d_model"), Bias::yes),
        dit_(s / "dit", backbone_.d_model()),
        action_in_(s / "action_in", s.dim("d_action"), dit_.d_model(), Bias::yes),
        action_mix_(s / "action_mix", 2 * dit_.d_model(), dit_.d_model(), Bias::yes),
        action_token_(s / "action_token", dit_.d_model(), dit_.d_model(), Bias::yes),
        decode_in_(s / "decode_in", dit_.d_out(), (s / "dit").dim("d_hidden"), Bias::yes),
        decode_out_(s / "decode_out", (s / "dit").dim("d_hidden"), s.dim("d_action"), Bias::yes),
        action_position_(s / "action_position", dit_.d_model(), s.dim("n_position")),
        d_time_((s / "dit").dim("d_time")),
        n_bucket_((s / "dit").dim("n_bucket")),
        horizon_(s.dim("horizon", 4096)),
        time_in_(s / "time_in", d_time_, dit_.d_model(), Bias::yes),
        time_out_(s / "time_out", dit_.d_model(), dit_.d_model(), Bias::yes) {
    const Scope vl = s / "vl";
    const int n_layer = vl.index("n_layer", 513), n_head = vl.dim("n_head", 1024);  // a model may do without layers
    for (int i = 0; i < n_layer; ++i)
      vl_blocks_.emplace_back(vl / "blk" / i, backbone_.d_model(), n_head, vl.dim("d_ff"),
                              vl.number("norm_eps", kNormEps));
    vl.require(n_layer == 0 || backbone_.d_model() % n_head == 0, "n_head",
               fmt::format("a divisor of lm.d_model {}", backbone_.d_model()), std::to_string(n_head));
    s.require(horizon_ <= s.dim("n_position"), "n_position", fmt::format("at least the horizon {}", horizon_),
              std::to_string(s.dim("n_position")));
    (s / "dit").require(d_time_ % 2 == 0 && d_time_ > 2, "d_time", "an even number above 2", std::to_string(d_time_));
    (s / "dit").require(dit_.d_model() % 2 == 0, "d_model", "an even number", std::to_string(dit_.d_model()));
  }

  Status check(const InputShape& shape) const override {
    VLA_CHECK(backbone_.check(shape.width, shape.height, shape.n_view, shape.n_text));
    return check_prefix(0, 0, shape.n_text);  // views are part of the text
  }

  Tensor condition(Graph& g, std::span<const float> times) const override {
    // The reference makes a whole number of i / N in double, whatever the times are.
    std::vector<int> buckets;
    for (std::size_t k = 0; k < times.size(); ++k)
      buckets.push_back(static_cast<int>(static_cast<double>(k) / static_cast<double>(times.size()) * n_bucket_));
    const auto embedded = [&](int d, BucketWaves waves) {
      return g.store().add_constant(bucket_embedding(buckets, d, waves),
                                    {d, static_cast<std::int64_t>(buckets.size())});
    };
    const Tensor hidden = silu(g, time_in_(g, embedded(d_time_, BucketWaves::cosines_first)));
    const Tensor modulations = dit_.modulations(g, silu(g, time_out_(g, hidden)));
    return concat_features(g, modulations, embedded(dit_.d_model(), BucketWaves::sines_first));
  }

  void constants(Graph& g, const std::function<Tensor()>&, Cache& cache) const override { backbone_.keep(g, cache); }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    Tensor x = vl_norm_(g, backbone_(g, in.images, in.tokens, cache));  // [d_model, n_text]
    for (const EncoderBlock& block : vl_blocks_) x = block(g, x);
    const auto [image, text] = backbone_.split(g, x);
    dit_.prepare(g, text, image, cache);
    const Tensor hidden = state_in_.activated(g, in.state, Activation::relu);
    cache.put(g, state_out_.path(), state_out_.forward(g, hidden));  // [d_dit, 1]
  }

  Tensor velocity(Graph& g, Tensor x_t, Tensor condition, const Cache& cache) const override {
    const Tensor action = action_in_(g, x_t);  // [d_dit, horizon]
    const Tensor time = slice_features(g, condition, dit_.d_modulations(), dit_.d_model());
    const Tensor timed = concat_features(g, action, repeat_like(g, time, action));
    const Tensor token = action_token_.forward(g, action_mix_.activated(g, timed, Activation::silu));
    const Tensor placed = add(g, token, action_position_(g, counting_ids(g, horizon_)));
    const Tensor x = concat_tokens(g, {cache.get(state_out_.path()), g.name(action_token_.path(), placed)});
    const Tensor out = slice_tokens(g, dit_(g, x, condition, cache), 1, horizon_);  // [d_out, horizon]
    return decode_out_(g, decode_in_.activated(g, out, Activation::relu));          // [d_action, horizon]
  }
};

/// nvidia/GR00T-N1.7-3B with two views of 256 x 256: 2.8 B parameters for one robot. Sources: Isaac-GR00T
/// gr00t/configs/model/gr00t_n1d7.py, lerobot policies/groot/groot_n1_7.py.
Keys published() {
  // clang-format off
  return Keys({
      {"policy.d_state", 132}, {"policy.d_action", 132}, {"policy.horizon", 40}, {"policy.n_position", 1024},
      {"policy.n_slot", 2}, {"policy.view_starts", std::vector<std::int64_t>{4, 70}},
      {"vision.d_model", 1024}, {"vision.n_layer", 24}, {"vision.n_head", 16}, {"vision.d_ff", 4096},
      {"vision.patch_size", 16}, {"vision.image_width", 256}, {"vision.image_height", 256},
      {"vision.n_position_side", 48}, {"vision.merge", 2}, {"vision.norm_eps", 1e-6}, {"vision.rope_base", 1e4},
      {"vision.deepstack_layers", std::vector<std::int64_t>{5, 11, 17}},
      {"lm.d_model", 2048}, {"lm.n_layer", 16}, {"lm.n_head", 16}, {"lm.n_head_kv", 8}, {"lm.d_head", 128},
      {"lm.d_ff", 6144}, {"lm.n_vocab", 151936}, {"lm.norm_eps", 1e-6}, {"lm.rope_base", 5e6},
      {"lm.rope_sections", std::vector<std::int64_t>{24, 20, 20}},
      {"vl.n_layer", 4}, {"vl.n_head", 32}, {"vl.d_ff", 8192}, {"vl.norm_eps", 1e-5},
      {"dit.d_model", 1536}, {"dit.n_layer", 32}, {"dit.n_head", 32}, {"dit.d_ff", 6144}, {"dit.d_out", 1024},
      {"dit.text_every", 2}, {"dit.d_time", 256}, {"dit.n_bucket", 1000}, {"dit.d_hidden", 1024},
      {"dit.norm_eps", 1e-5}, {"dit.out_eps", 1e-6}});
  // clang-format on
}

std::unique_ptr<Policy> make(ParamList& list) { return std::make_unique<Gr00tN17>(Scope(list, "")); }

}  // namespace

PolicyEntry gr00t_n1_7_policy() { return {"gr00t_n1_7", make, published}; }

}  // namespace vla
