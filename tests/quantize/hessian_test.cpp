// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// How errors of columns are made good by later ones.
#include "quantize/hessian.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>

#include "kernels/quantize_weights.h"
#include "quantize/hessians.h"
#include "support/golden_case.h"

namespace hessian_test {

using namespace vla;
using namespace vla::test;

namespace {

std::vector<float> normals(std::size_t n, unsigned seed) {
  std::mt19937 random(seed);
  std::normal_distribution<float> normal;
  std::vector<float> values(n);
  for (float& value : values) value = normal(random);
  return values;
}

/// x of 8 numbers that mix `n_source` sources: few of them make all columns depend on each other.
std::vector<float> mixed(std::size_t n_row, std::size_t d, std::size_t n_source) {
  const std::vector<float> sources = normals(n_row * n_source, 1), mix = normals(n_source * d, 2);
  std::vector<float> rows(n_row * d);
  for (std::size_t r = 0; r < n_row; ++r)
    for (std::size_t k = 0; k < d; ++k)
      for (std::size_t s = 0; s < n_source; ++s) rows[r * d + k] += sources[r * n_source + s] * mix[s * d + k];
  return rows;
}

}  // namespace

TEST_CASE("of two columns, the second makes good what both have in common") {
  Hessian hessian(2);
  hessian.add(std::vector<float>{1, 2, 3, -1});  // H = [10 -1; -1 5]
  const std::vector<float> feedback = std::move(hessian).feedback();
  CHECK(feedback[0] == 0);
  CHECK(feedback[1] == doctest::Approx(-1 / (5 + 0.01 * 15 / 2)));
  CHECK(feedback[2] == 0);
  CHECK(feedback[3] == 0);
}

TEST_CASE("what was never multiplied asks for nothing") {
  Hessian hessian(64);
  hessian.add(std::vector<float>(640));
  for (const float value : std::move(hessian).feedback()) CHECK(value == 0);
}

TEST_CASE("of many rows some are taken, and columns that are far apart have nothing to do with each other") {
  constexpr std::int64_t kWidth = kernels::kStretch + 64;
  CHECK(Hessian::size(kWidth) == sizeof(float) * (kernels::kStretch * kernels::kStretch + 64 * 64));
  Hessian few(kWidth), many(kWidth);
  const std::vector<float> row = normals(kWidth, 3);
  std::vector<float> rows;
  for (int i = 0; i < 1000; ++i) rows.insert(rows.end(), row.begin(), row.end());
  few.add(row), many.add(rows);
  const std::vector<float> a = std::move(few).feedback(), b = std::move(many).feedback();
  REQUIRE(a.size() == b.size());
  for (std::size_t i = 0; i < a.size(); i += 101) CHECK(a[i] == doctest::Approx(b[i]).epsilon(1e-3));
}

/// Products of weights and x, and how far codes of the weights miss them.
class Products {
 public:
  static constexpr std::int64_t kWidth = 192, kRows = 32;

  std::vector<float> feedback() const {
    Hessian hessian(kWidth);
    for (std::size_t r = 0; r < kSamples; r += 100)  // as taps come: some rows at a time
      hessian.add(std::span(x_).subspan(r * kWidth, 100 * kWidth));
    return std::move(hessian).feedback();
  }
  /// code: of an element of a row.
  template <class F>
  double missed(F code) const {
    double sum = 0;
    for (std::int64_t r = 0; r < kRows; ++r)
      for (std::size_t s = 0; s < kSamples; ++s) {
        double error = 0;
        for (std::int64_t k = 0; k < kWidth; ++k)
          error +=
              (weights[at(r * kWidth + k)] - static_cast<float>(code(r, k)) * scales[at(r)]) * x_[s * kWidth + at(k)];
        sum += error * error;
      }
    return std::sqrt(sum);
  }
  /// Rounds without feedback, then with it. Returns the share of errors that is left. codes: of all rows.
  template <class Codes, class F>
  double left(Codes* codes, F code) {
    const auto* const stored = reinterpret_cast<const std::byte*>(weights.data());
    const std::vector<float> compensation = feedback();
    std::vector<float> room(weights.size());
    kernels::quantize_weights(DType::f32, stored, kWidth, kRows, codes, scales.data(), room.data());
    const double without = missed(code);
    kernels::quantize_weights(DType::f32, stored, kWidth, kRows, compensation.data(), codes, scales.data(),
                              room.data());
    return missed(code) / without;
  }

  std::vector<float> weights = normals(kRows * kWidth, 4), scales = std::vector<float>(kRows);

 private:
  static constexpr std::size_t kSamples = 400;
  static std::size_t at(std::int64_t i) { return static_cast<std::size_t>(i); }
  std::vector<float> x_ = mixed(kSamples, kWidth, 24);
};

TEST_CASE("products of int4 codes miss a fraction with feedback") {
  Products products;
  std::vector<Int4Block> blocks(Products::kRows * Products::kWidth / 64);
  CHECK(products.left(blocks.data(), [&](std::int64_t r, std::int64_t k) {
    return blocks[static_cast<std::size_t>((r * Products::kWidth + k) / 64)][k % 64];
  }) < 0.3);
}

TEST_CASE("products of int8 codes miss a fraction with feedback") {
  Products products;
  std::vector<std::byte> codes(Products::kRows * Products::kWidth);
  const auto code = [&](std::int64_t r, std::int64_t k) {
    return static_cast<int>(static_cast<signed char>(codes[static_cast<std::size_t>(r * Products::kWidth + k)]));
  };
  CHECK(products.left(codes.data(), code) < 0.3);
  CHECK(products.missed(code) > 0);
}

TEST_CASE("with feedback, int8 has scales of the largest magnitudes, and NaN for a row that is not finite") {
  Products products;
  products.weights[5] = 1000;  // its error is nothing; what is added to others cannot exceed the largest code
  products.weights[Products::kWidth] = std::numeric_limits<float>::infinity();
  std::vector<std::byte> codes(Products::kRows * Products::kWidth);
  products.left(codes.data(), [](std::int64_t, std::int64_t) { return 0; });
  CHECK(products.scales[0] == 1000.0f / 127);
  CHECK(codes[5] == std::byte{127});
  CHECK(std::isnan(products.scales[1]));
  CHECK(std::all_of(codes.begin() + Products::kWidth, codes.begin() + 2 * Products::kWidth,
                    [](std::byte code) { return code == std::byte{0}; }));
}

TEST_CASE("most float matrices of golden cases have Hessians") {
  int n_known = 0, n_asked = 0;
  for (const std::string& name : golden_paths()) {
    CAPTURE(name);
    const GoldenCase golden = GoldenCase::read(name);
    const Judged seen = {golden.observation, golden.noise};
    Result<Hessians> hessians = Hessians::of(golden.bundle(), std::span(&seen, 1), {.n_thread = 1, .all_robots = true});
    REQUIRE(hessians.ok());
    const Result<Bundle> bundle = Bundle::open(golden.bundle());
    for (const TensorInfo& matrix : bundle->tensors()) {
      if (matrix.shape.size() != 2 || !is_float(matrix.type)) continue;
      const auto feedback = hessians->feedback(*bundle, matrix);
      REQUIRE_MESSAGE(feedback.ok(), feedback.error().message());
      CHECK((feedback->empty() || feedback->size_bytes() == Hessian::size(matrix.shape[0])));
    }
    n_known += hessians->n_known(), n_asked += hessians->n_asked();
  }
  CAPTURE(n_asked);
  CHECK(n_known > 0.6 * n_asked);
}

}  // namespace hessian_test
