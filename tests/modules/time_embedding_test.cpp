// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/time_embedding.h"

#include <doctest/doctest.h>

#include <cmath>

using namespace vla;

TEST_CASE("the time embedding starts at the shortest period and ends at the longest, sines before cosines") {
  const float times[] = {1.0f, 0.1f};
  const auto table = sinusoidal_time_embedding(times, 720, 4e-3, 4.0);
  REQUIRE(table.size() == 1440);
  const double t = 0.1f;  // the float32 time, promoted
  CHECK(table[720] == static_cast<float>(std::sin(2 * M_PI / 4e-3 * t)));
  CHECK(table[720 + 359] == doctest::Approx(std::sin(2 * M_PI / 4.0 * t)).epsilon(1e-6));
  CHECK(table[720 + 360] == static_cast<float>(std::cos(2 * M_PI / 4e-3 * t)));
}

TEST_CASE("double precision keeps the shortest period exact where float32 would lose 1e-4") {
  const float times[] = {1.0f};
  const float in_float32 = std::sin(2 * static_cast<float>(M_PI) / 4e-3f * 1.0f);
  CHECK(std::abs(sinusoidal_time_embedding(times, 720, 4e-3, 4.0)[0] - in_float32) > 1e-5);
}
