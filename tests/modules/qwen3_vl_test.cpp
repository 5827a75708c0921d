// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/qwen3_vl.h"

#include <doctest/doctest.h>

using namespace vla;

TEST_CASE("text behind a picture counts on from its longer side, and the tokens of a picture share a time") {
  // Four words, 8 x 8 tokens, two marks, 8 x 8 tokens, a mark and two words.
  const std::vector<int> starts = {4, 70};
  const auto places = prompt_places(starts, 8, 8, 137);
  REQUIRE(places.size() == 137);
  CHECK(places[3] == Place{3, 3, 3});
  CHECK(places[4] == Place{4, 4, 4});
  CHECK(places[4 + 8 * 2 + 5] == Place{4, 6, 9});
  CHECK(places[67] == Place{4, 11, 11});
  CHECK(places[68] == Place{12, 12, 12});
  CHECK(places[69] == Place{13, 13, 13});
  CHECK(places[70] == Place{14, 14, 14});
  CHECK(places[133] == Place{14, 21, 21});
  CHECK(places[134] == Place{22, 22, 22});
  CHECK(places[136] == Place{24, 24, 24});
}

TEST_CASE("rows and columns of an oblong picture are not confused") {
  const std::vector<int> starts = {1};
  const std::vector<Place> expected = {{0, 0, 0}, {1, 1, 1}, {1, 1, 2}, {1, 1, 3},
                                       {1, 2, 1}, {1, 2, 2}, {1, 2, 3}, {4, 4, 4}};
  CHECK(prompt_places(starts, 2, 3, 8) == expected);
  CHECK(prompt_places(starts, 3, 2, 8)[3] == Place{1, 2, 1});
}

TEST_CASE("a prompt that ends with a picture has no text behind it") {
  const std::vector<int> starts = {1, 2};
  CHECK(prompt_places(starts, 1, 1, 3) == std::vector<Place>{{0, 0, 0}, {1, 1, 1}, {2, 2, 2}});
}
