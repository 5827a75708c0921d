// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/taps.h"

#include <doctest/doctest.h>
#include <fmt/format.h>
#include <unistd.h>

#include <cmath>
#include <filesystem>

namespace taps_test {

using namespace vla;

TEST_CASE("taps of one path are told apart in a file") {
  const auto file = std::filesystem::temp_directory_path() / fmt::format("vla-taps-path-test-{}.gguf", ::getpid());
  REQUIRE(write_taps({{"vision.stem", {1}, {1.0f}}, {"vision.stem", {2}, {2.0f, 3.0f}}}, file).ok());
  const auto back = read_taps(file);
  std::filesystem::remove(file);
  REQUIRE(back.ok());
  REQUIRE(back->size() == 2);
  CHECK((back->at(0).path == "vision.stem" && back->at(1).path == "vision.stem.2"));
  CHECK(back->at(1).values == std::vector<float>{2.0f, 3.0f});
}

TEST_CASE("a pattern matches whole paths; * stands for any characters, commas separate patterns") {
  CHECK(match_path("lm.blk.3", "lm.blk.3"));
  CHECK_FALSE(match_path("lm.blk.3", "lm.blk.30"));
  CHECK_FALSE(match_path("blk.3", "lm.blk.3"));
  CHECK(match_path("lm.blk.*", "lm.blk.3.k"));
  CHECK(match_path("*.k", "lm.blk.3.k"));
  CHECK(match_path("step.*.x", "step.12.x"));
  CHECK(match_path("*", ""));
  CHECK(match_path("lm.*,chunk", "chunk"));
  CHECK(match_path(",chunk,", "chunk"));
  CHECK_FALSE(match_path("", "chunk"));
  CHECK_FALSE(match_path(",", ""));
}

TEST_CASE("taps come back from their file with names, shapes and numbers") {
  const auto file = std::filesystem::temp_directory_path() / fmt::format("vla-taps-test-{}.gguf", ::getpid());
  const std::vector<Tap> taps{{"lm.blk.0.k", {2, 3}, {1, 2, 3, 4, 5, 6}}, {"chunk", {1}, {-0.5f}}};
  REQUIRE(write_taps(taps, file).ok());
  const auto read = read_taps(file);
  std::filesystem::remove(file);
  REQUIRE(read.ok());
  REQUIRE(read->size() == taps.size());
  for (std::size_t i = 0; i < taps.size(); ++i) {
    CHECK((*read)[i].path == taps[i].path);
    CHECK((*read)[i].shape == taps[i].shape);
    CHECK((*read)[i].values == taps[i].values);
  }
  CHECK(read_taps(file).error().code == Code::io);
}

TEST_CASE("a difference is relative to the largest expected magnitude, and keeps the expected order") {
  const std::vector<Tap> expected{{"a", {2, 1}, {4, -8}}, {"absent", {1}, {1}}, {"b", {2}, {1, 0}}};
  const std::vector<Tap> got{{"b", {2}, {0, 1}}, {"a", {2}, {4, -6}}};
  const std::vector<TapDifference> found = compare_taps(expected, got);
  REQUIRE(found.size() == 2);
  CHECK(found[0].path == "a");  // dimensions of 1 at the end do not count
  CHECK(found[0].comparable);
  CHECK(found[0].max_abs == 2);
  CHECK(found[0].relative == 0.25);
  CHECK(found[0].within(0.25));
  CHECK_FALSE(found[0].within(0.2));
  CHECK(found[1].path == "b");
  CHECK(found[1].cosine == 0);
}

TEST_CASE("another shape and a number that is not finite are within no tolerance") {
  const Tap expected{"a", {2, 3}, {1, 2, 3, 4, 5, 6}};
  Tap turned = expected, infinite = expected;
  turned.shape = {3, 2};
  infinite.values[4] = INFINITY;
  for (const Tap& got : {turned, infinite}) CHECK_FALSE(compare_taps({expected}, {got}).front().within(1e9));
}

}  // namespace taps_test
