// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/host/segments.h"

#include <doctest/doctest.h>

#include <string>

namespace segments_test {

using namespace vla::lower;

namespace {

/// "2-5 bring 0-1 release 0, 5-6": all segments.
std::string text_of(const std::vector<Segment>& segments) {
  std::string text;
  for (const Segment& segment : segments) {
    if (!text.empty()) text += ", ";
    text += std::to_string(segment.begin) + "-" + std::to_string(segment.end);
    if (segment.groups.any())
      text += " bring " + std::to_string(segment.groups.first) + "-" + std::to_string(segment.groups.last);
    if (segment.released >= 0) text += " release " + std::to_string(segment.released);
  }
  return text;
}

constexpr Groups kNone = {};
constexpr Groups only(int group) { return {group, group}; }

std::string cut(const std::vector<Groups>& phases, std::size_t begin = 0) { return text_of(cut_phases(phases, begin)); }

}  // namespace

TEST_CASE("phases that read no group are one segment") {
  CHECK(cut({}) == "");
  CHECK(cut({kNone, kNone, kNone}, 4) == "4-7");
}

TEST_CASE("a group comes before the first phase that reads it and goes after the last") {
  CHECK(cut({kNone, only(0), kNone, only(0), kNone}) == "0-1, 1-4 bring 0-0 release 0, 4-5");
  CHECK(cut({only(0), only(1), only(1)}, 10) == "10-11 bring 0-0 release 0, 11-13 bring 1-1 release 1");
}

TEST_CASE("a group that the next segment reads as well stays") {
  CHECK(cut({only(0), {0, 1}, only(1), only(2)}) == "0-1 bring 0-0, 1-3 bring 0-1 release 1, 3-4 bring 2-2 release 2");
  CHECK(cut({{0, 1}, {1, 2}}) == "0-1 bring 0-1 release 0, 1-2 bring 1-2 release 2");
}

TEST_CASE("a group may be read again after others") {
  CHECK(cut({only(1), only(0), only(1)}) ==
        "0-1 bring 1-1 release 1, 1-2 bring 0-0 release 0, 2-3 bring 1-1 release 1");
}

TEST_CASE("groups of a phase are from the first to the last that it reads") {
  Groups groups;
  for (const int group : {-1, 4, -1, 2, 3}) groups.add(group);
  CHECK(groups.first == 2);
  CHECK(groups.last == 4);
}

}  // namespace segments_test
