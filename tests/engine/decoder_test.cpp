// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// A decoder that reads its answer token by token gives the logits of one that reads all tokens at once.
#include "modules/language/decoder.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <limits>

#include "nn/tokens.h"
#include "support/graph_runner.h"
#include "support/param_set.h"

namespace decoder_test {

using namespace vla;
using namespace vla::test;

namespace {

constexpr int kModel = 12, kLayer = 3, kFf = 20, kVocab = 9, kPrefix = 5, kToken = 4;

std::vector<ParamSet::Piece> weights() {
  std::vector<ParamSet::Piece> pieces;
  float seed = 0.3f;
  const auto add = [&](const std::string& name, int d_in, int d_out) {
    auto values = ramp(static_cast<std::size_t>(d_in) * static_cast<std::size_t>(d_out), seed += 0.01f);
    pieces.push_back(d_out == 1 ? ParamSet::Piece{name, {d_in}, std::move(values)}
                                : ParamSet::Piece{name, {d_in, d_out}, std::move(values)});
  };
  add("lm.token_embd.weight", kModel, kVocab), add("lm.head.weight", kModel, kVocab), add("lm.norm.weight", kModel, 1);
  for (int i = 0; i < kLayer; ++i) {
    const std::string at = "lm.blk." + std::to_string(i) + ".";
    add(at + "attn_norm.weight", kModel, 1), add(at + "ffn_norm.weight", kModel, 1);
    add(at + "attn_q.weight", kModel, 16), add(at + "attn_out.weight", 16, kModel);
    add(at + "attn_k.weight", kModel, 8), add(at + "attn_v.weight", kModel, 8);
    add(at + "ffn_gate.weight", kModel, kFf), add(at + "ffn_up.weight", kModel, kFf);
    add(at + "ffn_down.weight", kFf, kModel);
  }
  return pieces;
}

Keys sizes() {
  return Keys({{"lm.d_model", std::int64_t{kModel}},
               {"lm.n_layer", std::int64_t{kLayer}},
               {"lm.n_head", std::int64_t{2}},
               {"lm.n_head_kv", std::int64_t{1}},
               {"lm.d_head", std::int64_t{8}},
               {"lm.d_ff", std::int64_t{kFf}},
               {"lm.n_vocab", std::int64_t{kVocab}},
               {"lm.norm_eps", 1e-6},
               {"lm.rope_base", 1e4}});
}

struct Fixture {
  ParamSet set{weights(), sizes()};
  Decoder decoder{set.scope("lm"), kGemma, DecoderOutput::logits};
};

/// The prefix sees itself, what follows all that came before.
std::vector<float> at_once(const Fixture& of, const std::vector<float>& x, int n_token) {
  const int n = kPrefix + n_token;
  std::vector<float> mask(static_cast<std::size_t>(n * n), 0.0f);
  for (int query = 0; query < n; ++query)
    for (int key = std::max(kPrefix, query + 1); key < n; ++key)
      mask[static_cast<std::size_t>(query * n + key)] = -std::numeric_limits<float>::infinity();
  return run_graph(of.set.list(), [&](Graph& g) {
    Cache cache;
    const std::vector<float> seen(x.begin(), x.begin() + n * kModel);
    of.decoder.prefill(g, constant(g, seen, {kModel, n}), constant(g, mask, {n, n}), cache);
    return cache.get(g, "logits");
  });
}

/// Prefix and step as the engine runs them.
class TokenByToken {
 public:
  TokenByToken(const Fixture& of, const std::vector<float>& x, const std::string& kernels)
      : device_(std::move(*open_device(1, kernels))), prefix_(slots_), step_(slots_) {
    REQUIRE(device_->load(of.set.list(), true).ok());
    token_ = slots_.add_f32({kModel, 1, 1, 1}), k_ = slots_.add_i32({1, 1, 1, 1});
    of.decoder.prefill(prefix_, constant(prefix_, {x.begin(), x.begin() + kPrefix * kModel}, {kModel, kPrefix}), {},
                       cache_);
    step_.write(of.decoder.next(step_, step_.input(token_), step_.input(k_), kToken, cache_), cache_.slot("logits"));
    REQUIRE(device_->allocate(slots_).ok());
    LowerOptions changing = {{token_, k_}};
    changing.varying.insert(changing.varying.end(), cache_.appended().begin(), cache_.appended().end());
    programs_[0] = std::move(*device_->lower(prefix_)), programs_[1] = std::move(*device_->lower(step_, changing));
  }
  void fill_appended(float value) {
    for (const Slot* slot : cache_.appended()) {
      const std::vector<float> values(static_cast<std::size_t>(count(slot->shape)), value);
      device_->set(*slot, values.data(), slot->size());
    }
  }
  std::vector<float> prefix() {
    REQUIRE(programs_[0]->run().ok());
    REQUIRE(programs_[1]->prepare().ok());
    return device_->get(*cache_.slot("logits"));
  }
  std::vector<float> next(const float* token, std::int32_t k) {
    device_->set(*token_, token, token_->size()), device_->set(*k_, &k, sizeof(k));
    REQUIRE(programs_[1]->run().ok());
    return device_->get(*cache_.slot("logits"));
  }

 private:
  std::unique_ptr<Device> device_;
  Slots slots_;
  Graph prefix_, step_;
  Cache cache_;
  Slot *token_, *k_;
  std::array<std::unique_ptr<Program>, 2> programs_;
};

void check_close(const std::vector<float>& found, const std::vector<float>& expected) {
  REQUIRE(found.size() == expected.size());
  for (std::size_t i = 0; i < found.size(); ++i) CHECK(found[i] == doctest::Approx(double{expected[i]}).epsilon(1e-5));
}

}  // namespace

TEST_CASE("logits token by token are those of all tokens at once, whatever an earlier act left") {
  const Fixture of;
  const std::vector<float> x = ramp((kPrefix + kToken) * kModel, 1);
  for (const char* kernels : {"ggml", "portable", "float32"}) {
    CAPTURE(kernels);
    TokenByToken step(of, x, kernels);
    for (const float left : {0.0f, 3.0f}) {
      step.fill_appended(left);
      check_close(step.prefix(), at_once(of, x, 0));
      for (int k = 0; k < kToken; ++k)
        check_close(step.next(x.data() + (kPrefix + k) * kModel, k), at_once(of, x, k + 1));
    }
  }
}

}  // namespace decoder_test
