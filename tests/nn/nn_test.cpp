// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Formulas without weights: each operation against its definition in double precision.
#include <doctest/doctest.h>

#include <cmath>
#include <functional>

#include "kernels/kernel_set.h"
#include "nn/attention.h"
#include "nn/tokens.h"
#include "support/graph_runner.h"

namespace nn_test {

using namespace vla;
using test::ramp;
using test::run_graph;

namespace {

double gelu(double x) { return 0.5 * x * (1 + std::tanh(std::sqrt(2 / M_PI) * (x + 0.044715 * x * x * x))); }

struct Sizes {
  int d_head, n_head, n_head_kv, n_query, n_key;
};

/// The definition of attention, with a mask that lets query i see the first `n_seen(i)` keys.
std::vector<float> attention_by_hand(const Sizes& s, const std::vector<float>& q, const std::vector<float>& k,
                                     const std::vector<float>& v, bool causal) {
  std::vector<float> out;
  for (int i = 0; i < s.n_query; ++i)
    for (int h = 0; h < s.n_head; ++h) {
      const int kv = h / (s.n_head / s.n_head_kv), n_seen = causal ? s.n_key - s.n_query + i + 1 : s.n_key;
      std::vector<double> weight;
      double sum = 0;
      for (int j = 0; j < n_seen; ++j) {
        double dot = 0;
        for (int d = 0; d < s.d_head; ++d)
          dot += double{q[static_cast<std::size_t>((i * s.n_head + h) * s.d_head + d)]} *
                 k[static_cast<std::size_t>((j * s.n_head_kv + kv) * s.d_head + d)];
        weight.push_back(std::exp(dot / std::sqrt(s.d_head)));
        sum += weight.back();
      }
      for (int d = 0; d < s.d_head; ++d) {
        double mixed = 0;
        for (int j = 0; j < n_seen; ++j)
          mixed += weight[static_cast<std::size_t>(j)] / sum *
                   v[static_cast<std::size_t>((j * s.n_head_kv + kv) * s.d_head + d)];
        out.push_back(static_cast<float>(mixed));
      }
    }
  return out;
}

void check_close(const std::vector<float>& got, const std::vector<float>& expected, float tolerance) {
  REQUIRE(got.size() == expected.size());
  for (std::size_t i = 0; i < got.size(); ++i) CHECK(std::abs(got[i] - expected[i]) <= tolerance);
}

}  // namespace

TEST_CASE("gelu agrees with its definition over the whole range of float32") {
  std::vector<float> x = ramp(4099, 12);
  for (float edge : {0.0f, -0.0f, 1e-30f, -1e-30f, 100.0f, -100.0f, 1e30f, -1e30f}) x.push_back(edge);
  const auto y = run_graph([&](Graph& g) {
    return activate(g, test::constant(g, x, {static_cast<std::int64_t>(x.size())}), Activation::gelu_tanh);
  });
  for (std::size_t i = 0; i < x.size(); ++i) {
    const double expected = gelu(x[i]);
    // An absolute part for the negative tail, where the value itself is a difference of nearly equal numbers.
    CHECK(std::abs(y[i] - expected) <= 4e-7 * std::abs(expected) + 1e-7);
  }
}

TEST_CASE("gelu of erf and relu agree with their definitions on every choice of kernels") {
  std::vector<float> x = ramp(4099, 12);
  for (float edge : {0.0f, -0.0f, 1e-30f, -1e-30f, 100.0f, -100.0f, 1e30f, -1e30f, NAN}) x.push_back(edge);
  for (const KernelSet& set : usable_kernels()) {
    const auto run = [&](Activation activation) {
      return run_graph(
          [&](Graph& g) {
            return activate(g, test::constant(g, x, {static_cast<std::int64_t>(x.size())}), activation);
          },
          name_of(set));
    };
    const auto gelu = run(Activation::gelu_erf), relu = run(Activation::relu);
    CHECK(std::isnan(gelu.back()));
    CHECK(std::isnan(relu.back()));
    for (std::size_t i = 0; i + 1 < x.size(); ++i) {
      const double expected = x[i] / 2.0 * std::erfc(-x[i] * M_SQRT1_2);
      // ggml adds one to erf: 2^-24 of half of x, where x is above -6.
      const double lost = set == kernel_set::ggml ? 4e-7 : 0;
      CHECK(std::abs(gelu[i] - expected) <= 0x1p-22 * std::abs(expected) + lost + 0x1p-148);
      CHECK(relu[i] == std::max(x[i], 0.0f));
    }
  }
}

TEST_CASE("attention with grouped heads agrees with its definition, with and without a causal mask") {
  for (const Sizes s : {Sizes{16, 6, 2, 5, 17}, Sizes{8, 3, 3, 1, 1}, Sizes{64, 15, 5, 50, 177}})
    for (bool causal : {false, true}) {
      const auto q = ramp(static_cast<std::size_t>(s.d_head * s.n_head * s.n_query), 2),
                 k = ramp(static_cast<std::size_t>(s.d_head * s.n_head_kv * s.n_key), 1),
                 v = ramp(static_cast<std::size_t>(s.d_head * s.n_head_kv * s.n_key), 3);
      const auto got = run_graph([&](Graph& g) {
        const Tensor mask = causal ? causal_mask(g, s.n_key - s.n_query, s.n_query) : Tensor();
        return attention(g, test::constant(g, q, {s.d_head, s.n_head, s.n_query}),
                         {{test::constant(g, k, {s.d_head, s.n_head_kv, s.n_key}),
                           test::constant(g, v, {s.d_head, s.n_head_kv, s.n_key})}},
                         mask);
      });
      check_close(got, attention_by_hand(s, q, k, v, causal), 2e-6f);
    }
}

TEST_CASE("a group sees itself and earlier groups, and a later group stays unseen") {
  const int groups[] = {2, 1};
  const auto mask = run_graph([&](Graph& g) { return scale(g, group_mask(g, groups), 1); });
  const float hidden = -INFINITY;
  CHECK(mask == std::vector<float>{0, 0, hidden, 0, 0, hidden, 0, 0, 0});
}

TEST_CASE("pixel shuffle puts the patches of a square into one token, row by row") {
  // A 4 x 4 grid whose patch (r, c) holds the single feature 10 r + c, in two views.
  std::vector<float> x;
  for (int view = 0; view < 2; ++view)
    for (int r = 0; r < 4; ++r)
      for (int c = 0; c < 4; ++c) x.push_back(static_cast<float>(100 * view + 10 * r + c));
  const auto y = run_graph([&](Graph& g) { return pixel_shuffle(g, test::constant(g, x, {1, 16, 2}), 2); });
  CHECK(std::vector<float>(y.begin(), y.begin() + 8) == std::vector<float>{0, 1, 10, 11, 2, 3, 12, 13});
  CHECK(std::vector<float>(y.end() - 4, y.end()) == std::vector<float>{122, 123, 132, 133});
}

TEST_CASE("a slice holds the tokens of its range, and whatever takes tokens takes it") {
  constexpr int kWidth = 3, kToken = 5, kView = 2;
  const std::vector<float> x = ramp(kWidth * kToken * kView, 1);
  const auto at = [&](int view, int token, int i) {
    return x[static_cast<std::size_t>((view * kToken + token) * kWidth + i)];
  };
  using Use = std::function<Tensor(Graph&, Tensor)>;
  const auto use_slice = [&](int n_view, const Use& use, const std::string& isa) {
    return run_graph(
        [&](Graph& g) {
          const std::vector<float> some(x.begin(), x.begin() + kWidth * kToken * n_view);
          return use(g, slice_tokens(g, test::constant(g, some, {kWidth, kToken, n_view}), 1, 3));
        },
        isa);
  };
  const auto tokens = [&](Graph& g, float value, int n_view) {
    return test::constant(g, std::vector<float>(static_cast<std::size_t>(kWidth * n_view), value), {kWidth, 1, n_view});
  };
  for (const KernelSet& set : usable_kernels())
    for (int n_view : {1, kView}) {
      std::vector<float> same, between, factored, positive;
      for (int view = 0; view < n_view; ++view) {
        for (int i = 0; i < kWidth; ++i) between.push_back(2);
        for (int token = 1; token < 4; ++token)
          for (int i = 0; i < kWidth; ++i) {
            same.push_back(at(view, token, i));
            between.push_back(at(view, token, i));
            factored.push_back(at(view, token, i) * static_cast<float>(i + 1));
            positive.push_back(std::max(at(view, token, i), 0.0f));
          }
      }
      const auto run = [&](const Use& use) { return use_slice(n_view, use, name_of(set)); };
      CHECK(run([](Graph& g, Tensor s) { return scale(g, s, 1); }) == same);
      CHECK(run([](Graph& g, Tensor s) { return flatten_views(g, s); }) == same);
      CHECK(run([&](Graph& g, Tensor s) { return concat_tokens(g, {tokens(g, 2, n_view), s}); }) == between);
      CHECK(run([&](Graph& g, Tensor s) {
              return concat_tokens(g, {tokens(g, 2, n_view), scale(g, s, 1)});
            }) == between);
      CHECK(run([&](Graph& g, Tensor s) {
              return slice_tokens(g, concat_tokens(g, {tokens(g, 2, n_view), s}), 1, 3);
            }) == same);
      CHECK(run([&](Graph& g, Tensor s) { return add(g, s, scale(g, s, -1)); }) ==
            std::vector<float>(same.size(), 0.0f));
      CHECK(run([](Graph& g, Tensor s) { return activate(g, s, Activation::relu); }) == positive);
      CHECK(run([](Graph& g, Tensor s) {
              return multiply(g, s, test::constant(g, std::vector<float>{1, 2, 3}, {kWidth}));
            }) == factored);
    }
}

TEST_CASE("pixel shuffle takes the patches of every view behind a class token") {
  std::vector<float> x;
  for (int view = 0; view < 2; ++view)
    for (int i = -1; i < 4; ++i) x.push_back(static_cast<float>(10 * view + i));
  const auto y = run_graph([&](Graph& g) {
    return pixel_shuffle(g, slice_tokens(g, test::constant(g, x, {1, 5, 2}), 1, 4), 2);
  });
  CHECK(y == std::vector<float>{0, 1, 2, 3, 10, 11, 12, 13});
}

TEST_CASE("a tap of a view keeps its values when later nodes reuse the memory") {
  const std::vector<float> x = {1, 2, 3, 4};
  const auto y = run_graph([&](Graph& g) {
    return merge_heads(g, split_heads(g, scale(g, test::constant(g, x, {4, 1}), 2), 2));
  });
  CHECK(y == std::vector<float>{2, 4, 6, 8});
}

}  // namespace nn_test
