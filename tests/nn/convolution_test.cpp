// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Convolutions against their definition in double precision, and the places of cells.
#include "nn/convolution.h"

#include <doctest/doctest.h>

#include <cmath>

#include "nn/group_norm.h"
#include "nn/sine_positions.h"
#include "support/graph_runner.h"
#include "support/param_set.h"

namespace convolution_test {

using namespace vla;
using namespace vla::test;

namespace {

/// Number `i` of a pixel of images [d, width, height, n_view], zero beyond them.
struct Images {
  int d, width, height;
  std::vector<float> values;
  double at(int view, int y, int x, int i) const {
    if (x < 0 || y < 0 || x >= width || y >= height) return 0;
    return double{values[static_cast<std::size_t>(((view * height + y) * width + x) * d + i)]};
  }
};

}  // namespace

TEST_CASE("a convolution is the sum over its window, of a matrix with columns row, column, feature") {
  constexpr int kIn = 3, kOut = 5, kView = 2;
  const Images images = {kIn, 6, 9, ramp(kIn * 6 * 9 * kView, 1)};
  for (const auto& [size, stride] :
       {std::pair{3, 1}, std::pair{3, 2}, std::pair{7, 2}, std::pair{1, 2}, std::pair{1, 1}}) {
    CAPTURE(size);
    CAPTURE(stride);
    const int n_in = size * size * kIn;
    const std::vector<float> weight = ramp(static_cast<std::size_t>(n_in * kOut), 0.3f), bias = ramp(kOut, 1);
    ParamSet set({{"c.weight", {n_in, kOut}, weight}, {"c.bias", {kOut}, bias}});
    const Convolution convolution(set.scope() / "c", kIn, kOut, size, stride);
    Shape shape = {};
    const auto got = run_graph(set.list(), [&](Graph& g) {
      const Tensor y = convolution(g, constant(g, images.values, {kIn, images.width, images.height, kView}));
      shape = y.shape();
      return y;
    });
    const int n_column = (images.width - 1) / stride + 1, n_row = (images.height - 1) / stride + 1;
    CHECK(shape == Shape{kOut, n_column, n_row, kView});
    std::size_t place = 0;
    for (int view = 0; view < kView; ++view)
      for (int row = 0; row < n_row; ++row)
        for (int column = 0; column < n_column; ++column)
          for (int o = 0; o < kOut; ++o) {
            double sum = double{bias[static_cast<std::size_t>(o)]};
            for (int r = 0; r < size; ++r)
              for (int c = 0; c < size; ++c)
                for (int i = 0; i < kIn; ++i)
                  sum += double{weight[static_cast<std::size_t>(o * n_in + (r * size + c) * kIn + i)]} *
                         images.at(view, row * stride + r - size / 2, column * stride + c - size / 2, i);
            CHECK(std::abs(got[place++] - sum) <= 1e-5);
          }
  }
}

namespace {

/// Numbers of tokens [d, n], zero beyond them.
struct Tokens {
  int d, n;
  std::vector<float> values;
  double at(int token, int i) const {
    return token < 0 || token >= n ? 0 : double{values[static_cast<std::size_t>(token * d + i)]};
  }
};

/// Element (o, column) of a matrix with rows of `d_in`.
double element(const std::vector<float>& matrix, int d_in, int o, int column) {
  return double{matrix[static_cast<std::size_t>(o * d_in + column)]};
}

}  // namespace

TEST_CASE("a convolution over tokens is the sum over its window, also one that is wider than the tokens are many") {
  constexpr int kIn = 3, kOut = 5;
  for (const auto& [size, n] : {std::pair{1, 4}, std::pair{3, 6}, std::pair{5, 8}, std::pair{7, 2}}) {
    const Tokens x = {kIn, n, ramp(static_cast<std::size_t>(kIn * n), 1)};
    const std::vector<float> weight = ramp(static_cast<std::size_t>(size * kIn * kOut), 0.3f), bias = ramp(kOut, 1);
    ParamSet set({{"c.weight", {size * kIn, kOut}, weight}, {"c.bias", {kOut}, bias}});
    const TokenConvolution convolution(set.scope() / "c", kIn, kOut, size);
    const auto got = run_graph(set.list(), [&, n = n](Graph& g) {
      return convolution(g, constant(g, x.values, {kIn, n}));
    });
    REQUIRE(got.size() == static_cast<std::size_t>(kOut * n));
    for (int t = 0; t < n; ++t)
      for (int o = 0; o < kOut; ++o) {
        double sum = double{bias[static_cast<std::size_t>(o)]};
        for (int k = 0; k < size; ++k)
          for (int i = 0; i < kIn; ++i) sum += element(weight, size * kIn, o, k * kIn + i) * x.at(t + k - size / 2, i);
        CHECK(std::abs(got[static_cast<std::size_t>(t * kOut + o)] - sum) <= 1e-5);
      }
  }
}

TEST_CASE("tokens are halved and doubled as torch does it") {
  constexpr int kWidth = 3;
  for (const int n : {2, 6}) {
    const Tokens x = {kWidth, n, ramp(static_cast<std::size_t>(kWidth * n), 1)};
    const std::vector<float> three = ramp(3 * kWidth * kWidth, 0.3f), even = ramp(2 * kWidth * kWidth, 0.4f),
                             odd = ramp(2 * kWidth * kWidth, 0.5f), bias = ramp(kWidth, 1);
    ParamSet set({{"h.weight", {3 * kWidth, kWidth}, three},
                  {"h.bias", {kWidth}, bias},
                  {"d.even.weight", {2 * kWidth, kWidth}, even},
                  {"d.even.bias", {kWidth}, bias},
                  {"d.odd.weight", {2 * kWidth, kWidth}, odd},
                  {"d.odd.bias", {kWidth}, bias}});
    const HalvingConvolution halve(set.scope() / "h", kWidth);
    const DoublingConvolution twice(set.scope() / "d", kWidth);
    const auto run = [&](const auto& module) {
      return run_graph(set.list(), [&](Graph& g) { return module(g, constant(g, x.values, {kWidth, n})); });
    };
    const auto half = run(halve), doubled = run(twice);
    REQUIRE(half.size() == static_cast<std::size_t>(kWidth * n / 2));
    REQUIRE(doubled.size() == static_cast<std::size_t>(kWidth * n * 2));
    for (int o = 0; o < kWidth; ++o) {
      for (int t = 0; t < n / 2; ++t) {
        double sum = double{bias[static_cast<std::size_t>(o)]};
        for (int k = 0; k < 3; ++k)
          for (int i = 0; i < kWidth; ++i)
            sum += element(three, 3 * kWidth, o, k * kWidth + i) * x.at(2 * t + k - 1, i);
        CHECK(std::abs(half[static_cast<std::size_t>(t * kWidth + o)] - sum) <= 1e-5);
      }
      for (int t = 0; t < 2 * n; ++t) {
        const std::vector<float>& matrix = t % 2 == 0 ? even : odd;
        double sum = double{bias[static_cast<std::size_t>(o)]};
        for (int k = 0; k < 2; ++k)
          for (int i = 0; i < kWidth; ++i)
            sum += element(matrix, 2 * kWidth, o, k * kWidth + i) * x.at((t + 1) / 2 - 1 + k, i);
        CHECK(std::abs(doubled[static_cast<std::size_t>(t * kWidth + o)] - sum) <= 1e-5);
      }
    }
  }
}

TEST_CASE("a group of features is normed over all places of a view") {
  constexpr int kWidth = 6, kGroup = 2, kPlace = 12, kView = 2;
  const std::vector<float> x = ramp(kWidth * kPlace * kView, 3), weight = ramp(kWidth, 2), bias = ramp(kWidth, 1);
  ParamSet set({{"n.weight", {kWidth}, weight}, {"n.bias", {kWidth}, bias}});
  const GroupNorm norm(set.scope() / "n", kWidth, kGroup, 1e-5f);
  const auto got = run_graph(set.list(), [&](Graph& g) { return norm(g, constant(g, x, {kWidth, 3, 4, kView})); });
  REQUIRE(got.size() == x.size());
  constexpr int kIn = kWidth / kGroup;
  for (int view = 0; view < kView; ++view)
    for (int group = 0; group < kGroup; ++group) {
      const auto each = [&](const auto& see) {
        for (int place = 0; place < kPlace; ++place)
          for (int i = group * kIn; i < (group + 1) * kIn; ++i)
            see(static_cast<std::size_t>((view * kPlace + place) * kWidth + i), static_cast<std::size_t>(i));
      };
      double sum = 0, square = 0;
      each([&](std::size_t at, std::size_t) { sum += double{x[at]}, square += double{x[at]} * x[at]; });
      const double mean = sum / (kPlace * kIn), deviation = std::sqrt(square / (kPlace * kIn) - mean * mean + 1e-5);
      each([&](std::size_t at, std::size_t i) {
        CHECK(std::abs(got[at] - ((double{x[at]} - mean) / deviation * weight[i] + bias[i])) <= 1e-5);
      });
    }
}

TEST_CASE("planes of an image become its pixels one after the other") {
  const auto got = run_graph([](Graph& g) {
    return pixels_first(g,
                        constant(g, {0, 1, 2, 3, 4, 5, 10, 11, 12, 13, 14, 15, 20, 21, 22, 23, 24, 25}, {3, 2, 3, 1}));
  });
  CHECK(std::vector(got.begin(), got.begin() + 6) == std::vector<float>{0, 10, 20, 1, 11, 21});
  CHECK(got.back() == 25);
}

TEST_CASE("the places of cells are sines and cosines of row and column") {
  constexpr int kColumns = 3, kRows = 2, kWidth = 8;
  const auto got = run_graph([](Graph& g) { return sine_positions(g, kColumns, kRows, kWidth); });
  REQUIRE(got.size() == kColumns * kRows * kWidth);
  for (int row = 0; row < kRows; ++row)
    for (int column = 0; column < kColumns; ++column)
      for (int i = 0; i < kWidth; ++i) {
        const double share = i < 4 ? (row + 1.0) / kRows : (column + 1.0) / kColumns;
        const double angle = 2 * M_PI * share / std::pow(10000.0, (i % 4 / 2 * 2) / 4.0);
        const double expected = i % 2 == 0 ? std::sin(angle) : std::cos(angle);
        CHECK(std::abs(got[static_cast<std::size_t>((row * kColumns + column) * kWidth + i)] - expected) <= 5e-6);
      }
}

}  // namespace convolution_test
