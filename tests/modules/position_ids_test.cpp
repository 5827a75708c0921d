// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/position_ids.h"

#include <doctest/doctest.h>

#include <nlohmann/json.hpp>
#include <set>

#include "support/editable_bundle.h"

namespace position_ids_test {

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

TEST_CASE("a smaller image on the same table skips rows evenly") {
  const auto ids = vision_position_ids("bucketize_float32", 16, 32);
  REQUIRE(ids.ok());
  CHECK((*ids)[1] == 2);
  CHECK((*ids)[16] == 64);
}

TEST_CASE(
    "ids equal the reference's for every grid that it computes alike on every machine, and other grids are refused") {
  const auto json = nlohmann::json::parse(test::read_text(test::source_path("tests/golden/positions.json")));
  for (const auto& table : json.at("tables"))
    for (const char* precision : {"float32", "bfloat16"}) {
      const int grid = table.at("grid"), n_table = table.at("table");
      CAPTURE(grid);
      CAPTURE(n_table);
      CAPTURE(precision);
      const auto ids = vision_position_ids(std::string("bucketize_") + precision, grid, n_table);
      REQUIRE(ids.ok());
      const std::vector<std::int32_t> axis = table.at(precision);
      for (int i = 0; i < grid * grid; ++i)
        CHECK((*ids)[static_cast<std::size_t>(i)] ==
              axis[static_cast<std::size_t>(i / grid)] * n_table + axis[static_cast<std::size_t>(i % grid)]);
    }
  for (const auto& pair : json.at("machine_dependent")) {
    const auto ids = vision_position_ids("bucketize_float32", pair.at(0), pair.at(1));
    REQUIRE_FALSE(ids.ok());
    CHECK(ids.error().code == Code::unsupported);
  }
}

TEST_CASE("row_major gives patch i row i, and refuses a image of another size than the table's") {
  const auto ids = vision_position_ids("row_major", 3, 3);
  REQUIRE(ids.ok());
  CHECK(*ids == std::vector<std::int32_t>{0, 1, 2, 3, 4, 5, 6, 7, 8});
  for (int grid : {2, 4}) {
    const auto other = vision_position_ids("row_major", grid, 3);
    REQUIRE_FALSE(other.ok());
    CHECK(other.error().code == Code::unsupported);
  }
}

TEST_CASE("an unknown position rule is a bad bundle") {
  const auto ids = vision_position_ids("nearest", 32, 32);
  REQUIRE_FALSE(ids.ok());
  CHECK(ids.error().code == Code::bad_bundle);
}

}  // namespace position_ids_test
