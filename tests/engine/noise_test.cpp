// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/noise.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>

namespace noise_test {

using namespace vla;

TEST_CASE("seed 1 gives these values on every machine") {
  // Philox 4x32-10 with counters 0, 1, 2, 3 and key 1 through scipy.special.ndtri, rounded to float32.
  const auto noise = draw_noise("normal", 1, 4);
  REQUIRE(noise.ok());
  const std::vector<float> expected = {1.22790766f, 0.445437729f, -0.682689667f, 0.69868809f};
  CHECK(*noise == expected);
}

TEST_CASE("normal noise has mean 0, deviation 1 and the tails of a normal distribution") {
  const auto noise = draw_noise("normal", 42, 200000);
  REQUIRE(noise.ok());
  double sum = 0, square = 0;
  int beyond_two = 0;
  for (float x : *noise) sum += x, square += double{x} * x, beyond_two += std::abs(x) > 2;
  CHECK(std::abs(sum / 200000) < 0.01);
  CHECK(std::abs(square / 200000 - 1) < 0.02);
  CHECK(std::abs(beyond_two / 200000.0 - 0.0455) < 0.003);
}

TEST_CASE("uniform noise stays within [-1, 1) and reaches both ends") {
  const auto noise = draw_noise("uniform", 42, 100000);
  REQUIRE(noise.ok());
  const auto [least, most] = std::minmax_element(noise->begin(), noise->end());
  CHECK(*least >= -1.0f);
  CHECK(*least < -0.999f);
  CHECK(*most < 1.0f);
  CHECK(*most > 0.999f);
}

TEST_CASE("another kind of noise is a bad bundle") { CHECK(draw_noise("pink", 1, 4).error().code == Code::bad_bundle); }

}  // namespace noise_test
