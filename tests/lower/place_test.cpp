// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Where values lie and when they are computed: graphs of random operations, with more live at a time than a chain has,
// give what ggml gives, whatever is kept, hoisted or overwritten.
#include <map>
#include <random>

#include "lower_case.h"

namespace place_test {

using namespace vla;
using namespace vla::test;

namespace {

/// A graph of random operations on values [24, n, n_view] and their views. The seed decides everything.
class RandomGraph {
 public:
  RandomGraph(GraphRunner& r, const LowerParams& p, unsigned seed, bool name_all)
      : r_(r), g_(r.graph), p_(p), random_(seed), name_all_(name_all) {
    x_ = r.slot(ramp(24 * kToken, 1), {24, kToken, 1, 1});
    same_ = r.slot(ramp(24 * kToken, 1.2f), {24, kToken, 1, 1});
    values_ = {g_.input(x_), g_.input(same_), input(r, {24, kToken, 1, 1})};
  }

  void record(int n_operation) {
    for (int i = 0; i < n_operation; ++i) {
      if (i == n_operation / 2) g_.end_stage("half");
      Tensor y = scale(g_, step(), 0.5f);
      if (name_all_ && pick(3) == 0) y = g_.name("value." + std::to_string(i), y);
      values_.push_back(y);
    }
    Tensor all = values_.back();
    for (std::size_t i = 0; i < values_.size(); i += 3) all = add(g_, all, values_[i]);
    result_ = g_.name("result", all);
    g_.write(some(), x_);
  }
  const Slot* x() const { return x_; }
  const Slot* same() const { return same_; }

 private:
  static constexpr int kToken = 12;

  int pick(int n) { return static_cast<int>(random_() % static_cast<unsigned>(n)); }
  /// Any value, or one of the last few as networks use them.
  Tensor some() {
    const int n = static_cast<int>(values_.size());
    return values_[static_cast<std::size_t>(pick(2) == 0 ? pick(n) : n - 1 - pick(std::min(n, 4)))];
  }
  Tensor reshape(Tensor x, const Shape& shape) { return g_.add(op::Reshape{}, {x}, shape); }
  Tensor heads(Tensor x) { return split_heads(g_, x, 3); }
  Tensor norm(Tensor x) {
    return g_.add(op::Norm{pick(2) == 0 ? op::NormKind::rms : op::NormKind::layer, 1e-3f}, {x, p_.parameter(g_, 24)});
  }

  Tensor step() {
    const Activation activations[] = {Activation::gelu_tanh, Activation::gelu_erf, Activation::silu, Activation::relu,
                                      Activation::relu_squared};
    const Tensor x = some();
    switch (pick(14)) {
      case 0:
        return p_.linear(g_, pick(2) == 0 ? norm(x) : x, 24, pick(2) == 0, pick(2));
      case 1:
        return add(g_, some(),
                   multiply(g_, activate(g_, p_.linear(g_, x, 24), activations[pick(4)]), p_.parameter(g_, 24)));
      case 2: {
        const Tensor h = norm(x), gate = activate(g_, p_.linear(g_, h, 24, true, 0), activations[pick(4)]);
        return multiply(g_, gate, p_.linear(g_, h, 24, false, 1));
      }
      case 3:
        return p_.linear(g_, activate(g_, p_.linear(g_, x, 48), Activation::silu), 24);
      case 4:
        return norm(x);
      case 5: {
        Tensor q = heads(x), k = heads(some());
        const Tensor v = heads(some());
        const Tensor table = g_.constant("table", {8, kToken, 1, 1}, [] { return ramp(8 * kToken, 1); });
        if (pick(2) == 0) q = g_.add(op::Rope{}, {q, table});
        if (pick(2) == 0) k = g_.add(op::Rope{}, {k, table});
        if (pick(2) == 0) return attention(g_, q, {{k, v}}, {});
        const Tensor mask = causal_mask(g_, kToken, kToken);
        return attention(g_, q, {{heads(some()), heads(some())}, {k, v}}, mask);
      }
      case 6:
        return add(g_, x, some());
      case 7:
        return multiply(g_, x, slice_tokens(g_, some(), pick(kToken), 1));
      case 8:
        return add(g_, x, slice_features(g_, some(), pick(24), 1));
      case 9: {
        const int n = 1 + pick(kToken - 1);
        return concat_tokens(g_, {slice_tokens(g_, x, 0, n), slice_tokens(g_, some(), n, kToken - n)});
      }
      case 10: {
        const int n = 1 + pick(23);
        return concat(g_, {slice_features(g_, some(), n, 24 - n), slice_features(g_, x, 0, n)}, 0);
      }
      case 11:
        return reshape(pixel_shuffle(g_, x, 6, 2), {24, kToken, 1, 1});
      case 12:
        return activate(g_, x, activations[pick(4)]);
      default: {
        const Tensor ids =
            g_.constant_ids("ids", [] { return std::vector<std::int32_t>{0, 5, 2, 2, 11, 1, 7, 3, 9, 4, 10, 6}; });
        return g_.add(op::Gather{}, {x, ids});
      }
    }
  }

  GraphRunner& r_;
  Graph& g_;
  const LowerParams& p_;
  std::mt19937 random_;
  bool name_all_;
  std::vector<Tensor> values_;
  Slot *x_, *same_;
  Tensor result_;
};

/// Everything that a few runs leave: taps, which a visitor may see on the way, and the slot that each run overwrites.
std::vector<float> outcome(const std::string& kernels, const LowerParams& params, unsigned seed, bool taps, bool hoist,
                           bool sees = false) {
  GraphRunner runner(
      params.list(), kernels, [&](const std::string& path) { return taps || path == "result"; }, 2);
  RandomGraph random(runner, params, seed, true);
  random.record(25);
  LowerOptions options;
  if (hoist) options.varying = {random.x()};
  std::map<std::string, std::vector<float>> tapped;
  if (sees)
    options.see_tap = [&](const std::string& path, auto, auto values) {
      tapped[path] = {values.begin(), values.end()};
    };
  Program& program = runner.lower(options);
  if (sees) CHECK(program.taps().empty());
  std::vector<float> all;
  for (int i = 0; i < 3; ++i) {
    tapped.clear();
    runner.run();
    for (std::size_t j = 0; j < program.taps().size(); ++j) tapped[program.taps()[j].path] = program.tap(j);
    for (const auto& [path, values] : tapped) all.insert(all.end(), values.begin(), values.end());
    for (const float value : runner.get(random.x())) all.push_back(value);
  }
  return all;
}

}  // namespace

TEST_CASE("random graphs give what ggml gives, with every value kept or only the last, hoisted or not") {
  const LowerParams params;
  for (unsigned seed = 1; seed <= some_random(200); ++seed)
    for (const bool taps : {false, true}) {
      const auto expected = outcome("ggml", params, seed, taps, false);
      for (const KernelSet& set : lowered_kernels())
        for (const bool hoist : {false, true}) {
          CAPTURE(seed);
          CAPTURE(taps);
          CAPTURE(hoist);
          CAPTURE(name_of(set));
          check_close(outcome(name_of(set), params, seed, taps, hoist), expected, 1e-4);
        }
    }
}

TEST_CASE("a visitor sees the taps of random graphs before others take their memory") {
  const LowerParams params;
  for (unsigned seed = 1; seed <= some_random(200); ++seed)
    for (const bool taps : {false, true})
      for (const bool hoist : {false, true}) {
        CAPTURE(seed);
        CAPTURE(taps);
        CAPTURE(hoist);
        const auto kept = outcome("float32", params, seed, taps, hoist);
        CHECK(outcome("float32", params, seed, taps, hoist, true) == kept);
      }
}

#define VLA_SLOT_TEST(sentence) TEST_CASE(sentence* doctest::skip(lowered_kernels().empty()))

namespace {

/// What three runs leave in x, [24, 12], when each writes what `next` makes of it.
void check_overwritten(const std::function<Tensor(Graph&, const LowerParams&, Tensor)>& next) {
  const LowerParams params;
  const auto leave = [&](const std::string& kernels) {
    GraphRunner r(params.list(), kernels);
    Slot* x = r.slot(ramp(24 * 12, 1), {24, 12, 1, 1});
    r.graph.write(next(r.graph, params, r.graph.input(x)), x);
    r.lower({{x}});
    for (int i = 0; i < 3; ++i) r.run();
    return r.get(x);
  };
  for (const KernelSet& set : lowered_kernels()) {
    CAPTURE(name_of(set));
    check_close(leave(name_of(set)), leave("ggml"), 1e-5);
  }
}

}  // namespace

VLA_SLOT_TEST("a slot that is read and then overwritten is read first") {
  check_overwritten(
      [](Graph& g, const LowerParams& p, Tensor x) { return add(g, x, scale(g, p.linear(g, x, 24), 0.1f)); });
  check_overwritten([](Graph& g, const LowerParams& p, Tensor x) { return add(g, x, p.linear(g, x, 24)); });
  check_overwritten([](Graph& g, const LowerParams& p, Tensor x) { return p.linear(g, x, 24); });
  check_overwritten([](Graph& g, const LowerParams&, Tensor x) { return scale(g, x, 0.5f); });
  check_overwritten([](Graph& g, const LowerParams&, Tensor x) {
    return g.add(op::Norm{op::NormKind::rms, 1e-5f}, {x});
  });
  check_overwritten([](Graph&, const LowerParams&, Tensor x) { return x; });
}

VLA_SLOT_TEST("a slot whose rows all need one of its own rows is not overwritten under them") {
  check_overwritten([](Graph& g, const LowerParams&, Tensor x) { return add(g, x, slice_tokens(g, x, 0, 1)); });
  check_overwritten([](Graph& g, const LowerParams&, Tensor x) { return multiply(g, x, slice_tokens(g, x, 5, 1)); });
  check_overwritten([](Graph& g, const LowerParams&, Tensor x) {  // as the weight of a norm
    const Tensor w = g.add(op::Reshape{}, {slice_tokens(g, x, 0, 1)}, {24, 1, 1, 1});
    return g.add(op::Norm{op::NormKind::layer, 1e-5f}, {x, w});
  });
  check_overwritten([](Graph& g, const LowerParams&, Tensor x) {  // tokens in another order
    return concat_tokens(g, {slice_tokens(g, x, 4, 8), slice_tokens(g, x, 0, 4)});
  });
  check_overwritten([](Graph& g, const LowerParams&, Tensor x) {  // the same numbers, read at other places
    const Tensor wide = g.add(op::Repeat{}, {slice_tokens(g, x, 3, 1)}, {24, 12, 1, 1});
    return scale(g, wide, 0.5f);
  });
  check_overwritten([](Graph& g, const LowerParams&, Tensor x) {
    const Tensor last = slice_tokens(g, x, 11, 1);
    return activate(g, add(g, g.add(op::Repeat{}, {slice_tokens(g, x, 0, 1)}, {24, 12, 1, 1}), last), Activation::silu);
  });
}

VLA_SLOT_TEST("what is read behind a write in the same graph is what was written") {
  const LowerParams params;
  const auto run = [&](const std::string& kernels) {
    GraphRunner r(params.list(), kernels);
    Slot* x = r.slot(ramp(24 * 12, 1), {24, 12, 1, 1});
    const Tensor before = r.graph.input(x);
    r.graph.write(params.linear(r.graph, before, 24), x);
    r.graph.name("result", scale(r.graph, before, 2));
    r.lower();
    r.run();
    return r.tap("result");
  };
  for (const KernelSet& set : lowered_kernels()) check_close(run(name_of(set)), run("ggml"), 1e-5);
}

VLA_SLOT_TEST("programs of one device share working memory, whichever is lowered first") {
  const LowerParams params;
  const auto device = open_device(2, name_of(lowered_kernels().back()));
  REQUIRE(device.ok());
  REQUIRE((*device)->load(params.list(), true).ok());
  Slots slots;
  Slot *x = slots.add_f32({35, 5, 1, 1}), *kept = slots.add_f32({35, 5, 1, 1}), *y = slots.add_f32({35, 5, 1, 1});
  const auto next = [&](Graph& g, Tensor in) {
    return params.linear(g, activate(g, params.linear(g, in, 67), Activation::silu), 35);
  };
  Graph small(slots), large(slots);
  small.write(add(small, next(small, small.input(kept)), next(small, small.input(x))), y);
  Tensor z = large.input(x);
  std::vector<Tensor> all;
  for (int i = 0; i < 20; ++i) all.push_back(z = next(large, z));
  large.write(
      params.linear(large, activate(large, params.linear(large, concat_tokens(large, all), 67), Activation::relu), 35),
      slots.add_f32({35, 100, 1, 1}));
  REQUIRE((*device)->allocate(slots).ok());
  (*device)->set(*x, ramp(35 * 5, 1).data(), x->size());
  (*device)->set(*kept, ramp(35 * 5, 2).data(), kept->size());
  auto first = (*device)->lower(small, {{x}}), second = (*device)->lower(large);
  REQUIRE((first.ok() && second.ok()));
  REQUIRE(((*first)->prepare().ok() && (*first)->run().ok()));
  const auto alone = (*device)->Device::get(*y);
  REQUIRE((*second)->run().ok());
  REQUIRE((*first)->run().ok());  // without another prepare: what it left is the program's own
  CHECK((*device)->Device::get(*y) == alone);
}

}  // namespace place_test
