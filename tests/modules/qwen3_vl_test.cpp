// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/qwen3_vl.h"

#include <doctest/doctest.h>

namespace qwen3_vl_test {

using namespace vla;

TEST_CASE("text behind a image counts on from its longer side, and the tokens of a image share a time") {
  // Four words, 8 x 8 tokens, two marks, 8 x 8 tokens, a mark and two words.
  const std::vector<int> starts = {4, 70};
  const auto places = mrope_position_ids(starts, 8, 8, 137);
  REQUIRE(places.size() == 137);
  CHECK(places[3] == PositionId{3, 3, 3});
  CHECK(places[4] == PositionId{4, 4, 4});
  CHECK(places[4 + 8 * 2 + 5] == PositionId{4, 6, 9});
  CHECK(places[67] == PositionId{4, 11, 11});
  CHECK(places[68] == PositionId{12, 12, 12});
  CHECK(places[69] == PositionId{13, 13, 13});
  CHECK(places[70] == PositionId{14, 14, 14});
  CHECK(places[133] == PositionId{14, 21, 21});
  CHECK(places[134] == PositionId{22, 22, 22});
  CHECK(places[136] == PositionId{24, 24, 24});
}

TEST_CASE("rows and columns of a non-square image are not confused") {
  const std::vector<int> starts = {1};
  const std::vector<PositionId> expected = {{0, 0, 0}, {1, 1, 1}, {1, 1, 2}, {1, 1, 3},
                                            {1, 2, 1}, {1, 2, 2}, {1, 2, 3}, {4, 4, 4}};
  CHECK(mrope_position_ids(starts, 2, 3, 8) == expected);
  CHECK(mrope_position_ids(starts, 3, 2, 8)[3] == PositionId{1, 2, 1});
}

TEST_CASE("a prompt that ends with a image has no text behind it") {
  const std::vector<int> starts = {1, 2};
  CHECK(mrope_position_ids(starts, 1, 1, 3) == std::vector<PositionId>{{0, 0, 0}, {1, 1, 1}, {2, 2, 2}});
}

}  // namespace qwen3_vl_test
