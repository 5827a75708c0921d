// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Sequences cut, joined and masked: numbers that say where they stood.
#include <doctest/doctest.h>

#include <cmath>
#include <limits>

#include "nn/attention.h"
#include "nn/embedding.h"
#include "nn/tokens.h"
#include "support/graph_runner.h"

namespace tokens_test {

using namespace vla;
using test::run_graph;

namespace {

/// 0, 1, 2, ...
std::vector<float> counted(int count) {
  std::vector<float> values;
  for (int i = 0; i < count; ++i) values.push_back(static_cast<float>(i));
  return values;
}

Tensor numbers(Graph& g, std::initializer_list<std::int64_t> sizes) {
  return test::constant(g, counted(static_cast<int>(count(test::shape_of(sizes)))), sizes);
}

using Values = std::vector<float>;
constexpr float kHidden = -std::numeric_limits<float>::infinity();

}  // namespace

TEST_CASE("a token in front of every view's is dropped again without a trace") {
  const auto with = [](Graph& g) {
    return prepend_tokens(g, test::constant(g, Values{-1, -2}, {2}), numbers(g, {2, 3, 2}));
  };
  CHECK(run_graph(with) == Values{-1, -2, 0, 1, 2, 3, 4, 5, -1, -2, 6, 7, 8, 9, 10, 11});
  const auto two = [](Graph& g) {
    return prepend_tokens(g, test::constant(g, Values{-1, -2}, {1, 2}), numbers(g, {1, 1, 2}));
  };
  CHECK(run_graph(two) == Values{-1, -2, 0, -1, -2, 1});
  CHECK(run_graph([&](Graph& g) { return slice_tokens(g, with(g), 1, 3); }) == counted(12));
}

TEST_CASE("one view of several, and parts of any number in their order") {
  const auto got = run_graph([](Graph& g) {
    const Tensor x = numbers(g, {2, 2, 3});
    return concat_tokens(g, std::vector<Tensor>{one_view(g, x, 2), one_view(g, x, 0), one_view(g, x, 1)});
  });
  CHECK(got == Values{8, 9, 10, 11, 0, 1, 2, 3, 4, 5, 6, 7});
}

TEST_CASE("keys are cut where their tokens stand, and joined behind others") {
  const auto got = run_graph([](Graph& g) {
    const Tensor x = numbers(g, {2, 2, 3});
    return concat(g, {slice_keys(g, x, 2, 1), slice_keys(g, x, 0, 1)}, 2);
  });
  CHECK(got == Values{8, 9, 10, 11, 0, 1, 2, 3});
}

TEST_CASE("rows of a table by a part of a list of ids") {
  const auto got = run_graph([](Graph& g) {
    const Tensor ids = constant_ids(g, "some", {4, 0, 3, 1});
    return column(g, numbers(g, {1, 5}), slice_ids(g, ids, 1, 2));
  });
  CHECK(got == Values{0, 3});
}

TEST_CASE("features beyond the first few become zero in every column") {
  CHECK(run_graph([](Graph& g) { return zero_features_after(g, numbers(g, {3, 2}), 2); }) == Values{0, 1, 0, 3, 4, 0});
}

TEST_CASE("a matrix as one column and back keeps the order of its columns") {
  CHECK(run_graph([](Graph& g) { return reshape_width(g, flatten(g, numbers(g, {3, 2})), 2); }) == counted(6));
}

TEST_CASE("a causal mask hides what comes later and what is never seen, from itself too") {
  const auto got = run_graph([](Graph& g) { return causal_mask(g, std::vector<bool>{true, false, true}); });
  CHECK(got == Values{0, kHidden, kHidden, 0, kHidden, kHidden, 0, kHidden, 0});
}

TEST_CASE("groups apart see themselves alone, and some tokens are seen by all") {
  constexpr int kSizes[] = {1, 2};
  const auto apart = run_graph([&](Graph& g) { return apart_mask(g, kSizes); });
  CHECK(apart == Values{0, kHidden, kHidden, kHidden, 0, 0, kHidden, 0, 0});
  const auto first = run_graph([](Graph& g) { return first_mask(g, 1, 2, 3); });
  CHECK(first == Values{0, kHidden, 0, kHidden, 0, kHidden});
}

TEST_CASE("tanh is within 2^-22 of the exact one, and one of its sign where float32 has no other number") {
  const Values x = {0, 1e-6f, -0.01f, 0.5f, -1, 3, -9, 40, -1e8f, 1e8f};
  const auto got = run_graph([&](Graph& g) { return tanh_of(g, test::constant(g, x, {5, 2})); });
  REQUIRE(got.size() == x.size());
  for (std::size_t i = 0; i < x.size(); ++i) CHECK(std::abs(got[i] - std::tanh(static_cast<double>(x[i]))) <= 0x1p-22);
}

TEST_CASE("a key that stands for several weighs like that many") {
  const Values q = {0.3f, -1.2f}, k = {0.5f, 0.1f, -0.7f, 2.0f, -0.7f, 2.0f, -0.7f, 2.0f},
               v = {1, 2, 5, -4, 5, -4, 5, -4};
  const auto attend = [&](int n_key, const std::vector<int>& copies) {
    return run_graph([&](Graph& g) {
      const auto part = [&](const Values& x, int n) {
        return test::constant(g, Values(x.begin(), x.begin() + 2 * n), {2, 1, n});
      };
      return attention(g, part(q, 1), {{part(k, n_key), part(v, n_key)}}, copies_mask(g, copies, 1));
    });
  };
  const Values all = attend(4, {1, 1, 1, 1}), short_cut = attend(2, {1, 3});
  for (std::size_t i = 0; i < all.size(); ++i) CHECK(short_cut[i] == doctest::Approx(all[i]).epsilon(1e-6));
}

TEST_CASE(
    "pixel shuffle of a non-square image puts squares row by row, and their patches apart again are in that order") {
  // Two views of 2 rows of 4 patches with two features each.
  const auto shuffled = [](Graph& g) { return pixel_shuffle(g, numbers(g, {2, 8, 2}), 4, 2); };
  const Values first = {0, 1, 2, 3, 8, 9, 10, 11, 4, 5, 6, 7, 12, 13, 14, 15};
  Values both = first;
  for (const float value : first) both.push_back(value + 16);
  CHECK(run_graph(shuffled) == both);
  CHECK(run_graph([&](Graph& g) { return reshape_width(g, shuffled(g), 2); }) == both);
  CHECK(run_graph([&](Graph& g) { return one_view(g, reshape_width(g, shuffled(g), 2), 1); }) ==
        Values(both.begin() + 16, both.end()));
}

TEST_CASE("a token's own factor scales all its numbers") {
  const auto got = run_graph([](Graph& g) {
    return multiply(g, numbers(g, {3, 2}), test::constant(g, Values{2, -1}, {1, 2}));
  });
  CHECK(got == Values{0, 2, 4, -3, -4, -5});
}

TEST_CASE("filled tokens hold their number, and others of the same shape another") {
  const auto got = run_graph([](Graph& g) { return concat_tokens(g, {full(g, 0, 2, 1), full(g, 1.5f, 2, 1)}); });
  CHECK(got == Values{0, 0, 1.5f, 1.5f});
}

}  // namespace tokens_test
