// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/patch_grid.h"

#include <doctest/doctest.h>

#include <cmath>
#include <set>

namespace patch_grid_test {

using namespace vla;

TEST_CASE("squares of patches follow each other row by row, and the patches of a square likewise") {
  const std::vector<PositionId> expected = {{0, 0, 0}, {0, 0, 1}, {0, 1, 0}, {0, 1, 1}, {0, 0, 2}, {0, 0, 3},
                                            {0, 1, 2}, {0, 1, 3}, {0, 2, 0}, {0, 2, 1}, {0, 3, 0}, {0, 3, 1},
                                            {0, 2, 2}, {0, 2, 3}, {0, 3, 2}, {0, 3, 3}};
  CHECK(merge_block_places(4, 4, 2) == expected);
  const auto wide = merge_block_places(6, 3, 3);
  CHECK(std::set<PositionId>(wide.begin(), wide.end()).size() == 18);
  CHECK(wide[4] == PositionId{0, 1, 1});
  CHECK(wide[9] == PositionId{0, 3, 0});
}

TEST_CASE("a table stretched over a image is a bilinear blend whose corners are the image's") {
  constexpr int kRow = 6, kColumn = 8;
  for (const int n_side : {5, 48, 1}) {
    const auto places = merge_block_places(kRow, kColumn, 2);
    const PositionBlend blend = blend_positions(places, kRow, kColumn, n_side);
    for (std::size_t i = 0; i < places.size(); ++i) {
      // Of a table that holds its own row and column, a blend is where the patch lies.
      double row = 0, column = 0, whole = 0;
      for (int corner = 0; corner < 4; ++corner) {
        const int id = blend.ids[corner][i];
        REQUIRE(id >= 0);
        REQUIRE(id < n_side * n_side);
        const double weight = double{blend.weights[corner][i]};
        CHECK(weight >= 0);
        row += weight * (id / n_side), column += weight * (id % n_side), whole += weight;
      }
      CHECK(whole == doctest::Approx(1).epsilon(1e-6));
      CHECK(std::abs(row - places[i][1] * double(n_side - 1) / (kRow - 1)) < 1e-5);
      CHECK(std::abs(column - places[i][2] * double(n_side - 1) / (kColumn - 1)) < 1e-5);
    }
  }
}

TEST_CASE("a image with as many patches as the table has rows reads one row for each") {
  const auto places = merge_block_places(4, 4, 2);
  const PositionBlend blend = blend_positions(places, 4, 4, 4);
  for (std::size_t i = 0; i < places.size(); ++i) {
    CHECK(blend.ids[0][i] == 4 * places[i][1] + places[i][2]);
    CHECK(blend.weights[0][i] == 1);
  }
}

TEST_CASE("a single row of patches reads the first row of the table") {
  const auto places = merge_block_places(1, 3, 1);
  const PositionBlend blend = blend_positions(places, 1, 3, 3);
  CHECK(blend.ids[0] == std::vector<std::int32_t>{0, 1, 2});
  CHECK(blend.weights[0] == std::vector<float>{1, 1, 1});
}

}  // namespace patch_grid_test
