// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/rope.h"

#include <doctest/doctest.h>

#include <cmath>
#include <numbers>

#include "base/bf16.h"
#include "kernels/kernel_set.h"
#include "support/graph_runner.h"

namespace rope_test {

using namespace vla;
using test::ramp;
using test::run_graph;

namespace {

/// Checks x [d_head, n_head, n_token, n_batch] turned by a table: pair i of token j by angle(j, i).
template <class MakeTable, class Angle>
void check_turned(int d_head, int n_token, const MakeTable& make_table, const Angle& angle) {
  constexpr int kHeads = 2, kBatches = 2;
  const std::vector<float> x = ramp(static_cast<std::size_t>(d_head * kHeads * n_token * kBatches), 1);
  for (const KernelSet& set : usable_kernels()) {
    const auto y = run_graph(
        [&](Graph& g) {
          return apply_rope(g, test::constant(g, x, {d_head, kHeads, n_token, kBatches}), make_table(g));
        },
        name_of(set));
    REQUIRE(y.size() == x.size());
    for (int row = 0; row < kHeads * n_token * kBatches; ++row)
      for (int i = 0; i < d_head / 2; ++i) {
        const auto at = static_cast<std::size_t>(row * d_head + i), other = at + static_cast<std::size_t>(d_head / 2);
        const double turn = angle(row / kHeads % n_token, i);
        CHECK(std::abs(y[at] - (x[at] * std::cos(turn) - x[other] * std::sin(turn))) <= 4e-6);
        CHECK(std::abs(y[other] - (x[other] * std::cos(turn) + x[at] * std::sin(turn))) <= 4e-6);
      }
  }
}

}  // namespace

TEST_CASE("rope turns half-split pairs, which differs from interleaved ones, for d_head = 64") {
  constexpr int kHead = 64, kTokens = 3, kFirst = 200;
  const std::vector<float> x = ramp(kHead * 2 * kTokens, 1);
  const auto y = run_graph([&](Graph& g) {
    return apply_rope(g, test::constant(g, x, {kHead, 2, kTokens}), 10000.0f, RotaryAngle::quotient, kFirst);
  });
  double interleaved_difference = 0;
  for (int token = 0; token < kTokens; ++token)
    for (int head = 0; head < 2; ++head)
      for (int i = 0; i < kHead / 2; ++i) {
        const std::size_t at = static_cast<std::size_t>((token * 2 + head) * kHead + i), other = at + kHead / 2;
        const double angle = (kFirst + token) / std::pow(10000.0, 2.0 * i / kHead);
        CHECK(std::abs(y[at] - (x[at] * std::cos(angle) - x[other] * std::sin(angle))) <=
              3e-5);  // float32 angles up to 202
        CHECK(std::abs(y[other] - (x[other] * std::cos(angle) + x[at] * std::sin(angle))) <= 3e-5);
        const std::size_t even = at - static_cast<std::size_t>(i) + 2 * static_cast<std::size_t>(i);
        interleaved_difference = std::max(
            interleaved_difference, std::abs(y[even] - (x[even] * std::cos(angle) - x[even + 1] * std::sin(angle))));
      }
  CHECK(interleaved_difference > 0.1);
}

TEST_CASE(
    "neighbours turn by angles of a half-split rope in bfloat16, each by its own, and the first of all come first") {
  constexpr int kHeads = 2, kTokens = 3;
  for (const int d_head : {6, 8}) {
    const std::vector<float> x = ramp(static_cast<std::size_t>(d_head * kHeads * kTokens), 1);
    const auto y = run_graph([&](Graph& g) {
      return apply_uneven_rope(g, test::constant(g, x, {d_head, kHeads, kTokens}), 100.0f);
    });
    REQUIRE(y.size() == x.size());
    for (int row = 0; row < kHeads * kTokens; ++row)
      for (int j = 0; j < d_head; ++j) {
        const auto rounded = [](double number) { return double{from_bf16(to_bf16(static_cast<float>(number)))}; };
        const double turn = rounded(row / kHeads * rounded(std::pow(100.0, -2.0 * (j % (d_head / 2)) / d_head)));
        const auto at = [&](int i) { return double{x[static_cast<std::size_t>(row * d_head + i)]}; };
        const double other = j % 2 == 0 ? -at(j + 1) : at(j - 1);
        const int placed = j / 2 + (j % 2 == 0 ? 0 : d_head / 2);
        CHECK(std::abs(y[static_cast<std::size_t>(row * d_head + placed)] -
                       (at(j) * rounded(std::cos(turn)) + other * rounded(std::sin(turn)))) <= 4e-6);
      }
  }
}

TEST_CASE("rotary angles are rounded as either reference rounds them, which differs at large positions") {
  // Angles as transformers' GemmaRotaryEmbedding and SmolVLA's apply_rope make them with torch 2.13, for d_head = 256.
  constexpr int kHead = 256, kPosition = 800, kPair = 15;
  constexpr double kProductAngle = 271.8566589355469, kQuotientAngle = 271.856689453125;
  std::vector<float> x(kHead, 0.0f);
  x[kPair] = 1;
  const auto turned = [&](RotaryAngle angle) {
    return run_graph([&](Graph& g) {
      return apply_rope(g, test::constant(g, x, {kHead, 1, 1}), 10000.0f, angle, kPosition);
    });
  };
  const auto product = turned(RotaryAngle::product), quotient = turned(RotaryAngle::quotient);
  CHECK(product[kPair] == doctest::Approx(std::cos(kProductAngle)).epsilon(1e-6));
  CHECK(quotient[kPair] == doctest::Approx(std::cos(kQuotientAngle)).epsilon(1e-6));
  CHECK(std::abs(product[kPair] - quotient[kPair]) > 1e-5);
}

TEST_CASE("rope at given positions turns every token as rope of that position alone does") {
  constexpr int kHead = 64;
  const std::vector<int> apart = {7, 7, 0, 1023, 12}, in_order = {7, 8, 9, 10, 11}, beginning = {7, 8, 9};
  const std::vector<float> x = ramp(kHead * 2 * apart.size(), 1);
  const auto token = [&](std::size_t j) {
    return std::vector<float>(x.begin() + static_cast<std::ptrdiff_t>(j * 2 * kHead),
                              x.begin() + static_cast<std::ptrdiff_t>((j + 1) * 2 * kHead));
  };
  const auto turn = [](Graph& g, const std::vector<float>& values, auto place) {
    const Tensor q = test::constant(g, values, {kHead, 2, static_cast<std::int64_t>(values.size()) / (2 * kHead)});
    return apply_rope(g, q, rotary_table(g, kHead, 1e6f, RotaryAngle::product, place));
  };
  for (const std::vector<int>& positions : {apart, in_order, beginning}) {
    const std::vector<float> some(x.begin(), x.begin() + static_cast<std::ptrdiff_t>(positions.size() * 2 * kHead));
    // A graph that already holds other tables takes none of those.
    const auto got = run_graph([&](Graph& g) {
      for (const std::vector<int>& other : {in_order, beginning, apart})
        turn(g, std::vector<float>(other.size() * 2 * kHead, 1.0f), std::span<const int>(other));
      return turn(g, some, std::span<const int>(positions));
    });
    std::vector<float> expected;
    for (std::size_t j = 0; j < positions.size(); ++j)
      for (float value : run_graph([&](Graph& g) { return turn(g, token(j), std::span(&positions[j], 1)); }))
        expected.push_back(value);
    CHECK(got == expected);
  }
}

TEST_CASE("patches turn by their row in the first half of the pairs and by their column in the second, in every view") {
  const std::vector<PositionId> places = {{0, 0, 0}, {0, 0, 1}, {0, 5, 2}, {9, 3, 15}};
  for (const int d_head : {64, 12}) {
    const int quarter = d_head / 4;
    check_turned(
        d_head, 4, [&](Graph& g) { return grid_rotary_table(g, d_head, 1e4f, places); },
        [&](int j, int i) {
          const PositionId& place = places[static_cast<std::size_t>(j)];
          return place[i < quarter ? 1 : 2] / std::pow(1e4, 4.0 * (i % quarter) / d_head);
        });
  }
}

TEST_CASE("patches turn by where their centre is on an image from -1 to 1, and the tokens in front of them do not") {
  constexpr int kFirst = 2, kRows = 2, kColumns = 3;
  for (const int d_head : {64, 12}) {
    const int quarter = d_head / 4;
    check_turned(
        d_head, kFirst + kRows * kColumns,
        [&](Graph& g) { return centre_rotary_table(g, d_head, 100.0f, kFirst, kRows, kColumns); },
        [&](int j, int i) {
          if (j < kFirst) return 0.0;
          const int patch = j - kFirst;
          const double y = (patch / kColumns + 0.5) / kRows, x = (patch % kColumns + 0.5) / kColumns;
          const double at = 2 * (i < quarter ? y : x) - 1;
          return 2 * std::numbers::pi * at / std::pow(100.0, 4.0 * (i % quarter) / d_head);
        });
  }
}

TEST_CASE("time, rows and columns take turns among the pairs until their shares end, and the rest is time's") {
  const std::vector<PositionId> places = {{0, 0, 0}, {4, 11, 7}, {14, 14, 21}};
  struct Layout {
    int d_head;
    std::array<int, 3> sections;
  };
  for (const Layout& layout : {Layout{128, {24, 20, 20}}, Layout{16, {4, 2, 2}}, Layout{16, {5, 1, 2}}}) {
    std::vector<std::size_t> axis(static_cast<std::size_t>(layout.d_head / 2), 0);
    for (const std::size_t other : {1, 2})
      for (std::size_t n = 0; n < static_cast<std::size_t>(layout.sections[other]); ++n) axis[3 * n + other] = other;
    check_turned(
        layout.d_head, 3, [&](Graph& g) { return mrope_table(g, layout.d_head, 5e6f, layout.sections, places); },
        [&](int j, int i) {
          return places[static_cast<std::size_t>(j)][axis[static_cast<std::size_t>(i)]] /
                 std::pow(5e6, 2.0 * i / layout.d_head);
        });
  }
}

TEST_CASE("text among images turns as text alone") {
  const std::vector<int> positions = {0, 3, 117};
  const std::vector<PositionId> places = {{0, 0, 0}, {3, 3, 3}, {117, 117, 117}};
  const auto one = run_graph([&](Graph& g) { return rotary_table(g, 128, 5e6f, RotaryAngle::product, positions); });
  CHECK(one == run_graph([&](Graph& g) { return mrope_table(g, 128, 5e6f, {24, 20, 20}, places); }));
}

}  // namespace rope_test
