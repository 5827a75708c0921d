// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/timestep_embedding.h"

#include <doctest/doctest.h>

#include <cmath>

namespace timestep_embedding_test {

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

TEST_CASE("whole-numbered times are embedded as either reference rounds, which naive double precision does not") {
  // Values of diffusers 0.35 and lerobot 0.6 with torch 2.13, at time 750.
  const float buckets[] = {0, 750};
  const auto cosines = wave_embedding(buckets, 256, TimeWaves::cosines_first);
  const auto sines = wave_embedding(buckets, 1536, TimeWaves::sines_first);
  REQUIRE(cosines.size() == 512);
  REQUIRE(sines.size() == 3072);
  CHECK(cosines[127] == 1);
  CHECK(cosines[128] == 0);
  CHECK(sines[0] == 0);
  CHECK(sines[768] == 1);
  const auto close = [](float got, double expected) { return std::abs(got - expected) <= 1.3e-7; };
  CHECK(close(cosines[256 + 2], 0.0011510324));
  CHECK(close(cosines[256 + 60], -0.970776081));
  CHECK(close(cosines[256 + 128 + 5], 0.378294796));
  CHECK(close(sines[1536 + 16], -0.15867433));
  CHECK(close(sines[1536 + 300], 0.993069768));
  CHECK(close(sines[1536 + 768 + 16], -0.987330973));
  CHECK_FALSE(close(cosines[256 + 2], std::cos(750 * std::pow(1e4, -2.0 / 127))));
}

TEST_CASE("slow waves put cosines first, and an odd width ends in a zero") {
  // Values of lerobot 0.6's timestep_embedding with torch 2.13, at time 0.7.
  const float times[] = {1.0f, 0.7f};
  const auto table = wave_embedding(times, 33, TimeWaves::slow_cosines);
  REQUIRE(table.size() == 66);
  const auto close = [&](std::size_t i, double expected) { return std::abs(table[33 + i] - expected) <= 6e-8; };
  CHECK(close(0, 0.764842212));
  CHECK(close(1, 0.865361035));
  CHECK(close(15, 0.999956429));
  CHECK(close(16, 0.64421767));
  CHECK(close(25, 0.0524684861));
  CHECK(close(31, 0.00933451392));
  CHECK(table[32] == 0);
  CHECK(table[65] == 0);
}

}  // namespace timestep_embedding_test
