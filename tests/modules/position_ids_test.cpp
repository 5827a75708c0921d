// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/position_ids.h"

#include <doctest/doctest.h>

#include <set>

using namespace vla;

TEST_CASE("a full 32 x 32 grid reads every row of its table once, in order") {
  const auto ids = vision_position_ids("bucketize_float32", 32, 32);
  REQUIRE(ids.ok());
  for (int i = 0; i < 1024; ++i) CHECK((*ids)[static_cast<std::size_t>(i)] == i);
}

TEST_CASE("the shifted rule reads row 0 twice and never the last, in both axes") {
  const auto ids = vision_position_ids("bucketize_shifted", 32, 32);
  REQUIRE(ids.ok());
  for (int r = 0; r < 32; ++r)
    for (int c = 0; c < 32; ++c)
      CHECK((*ids)[static_cast<std::size_t>(32 * r + c)] == 32 * std::max(r - 1, 0) + std::max(c - 1, 0));
  CHECK(std::set<int>(ids->begin(), ids->end()).size() == 31 * 31);
}

TEST_CASE("a smaller picture on the same table skips rows evenly") {
  const auto ids = vision_position_ids("bucketize_float32", 16, 32);
  REQUIRE(ids.ok());
  CHECK((*ids)[1] == 2);
  CHECK((*ids)[16] == 64);
}

TEST_CASE("a grid whose ids depend on the machine's vector width is refused") {
  const auto ids = vision_position_ids("bucketize_float32", 25, 25);
  REQUIRE_FALSE(ids.ok());
  CHECK(ids.error().code == Code::unsupported);
}

TEST_CASE("an unknown position rule is a bad bundle") {
  const auto ids = vision_position_ids("nearest", 32, 32);
  REQUIRE_FALSE(ids.ok());
  CHECK(ids.error().code == Code::bad_bundle);
}
