// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Convolutions against their definition in double precision, and the places of cells.
#include "nn/convolution.h"

#include <doctest/doctest.h>

#include <cmath>

#include "nn/sine_positions.h"
#include "support/graph_runner.h"
#include "support/param_set.h"

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
