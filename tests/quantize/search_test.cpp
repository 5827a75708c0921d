// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/search.h"

#include <doctest/doctest.h>

#include <cmath>

namespace search_test {

using namespace vla;

TEST_CASE("how far chunks move is told over all observations, of the largest number, and of the median observation") {
  const Chunks expected = {{3, 4}, {0, 5}, {5, 0}};  // 75 in squares
  const Chunks got = {{3, 4.5f}, {3, 5}, {5, 1}};
  const Moved result = moved(expected, got);
  CHECK(result.rms == doctest::Approx(std::sqrt((0.25 + 9 + 1) / 75)));
  CHECK(result.largest == doctest::Approx(3.0 / 5));
  CHECK(result.median == doctest::Approx(std::sqrt(1.0 * 3 / 75)));
  CHECK(moved({{0, 0}}, {{0, 0}}).rms == 0);
}

}  // namespace search_test
