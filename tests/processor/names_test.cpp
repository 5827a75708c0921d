// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/names.h"

#include <doctest/doctest.h>

namespace names_test {

using namespace vla;

namespace {

const FeatureNames kViews("view", {"observation.images.top", "observation.images.wrist", "other.wrist", "side"},
                          {"observation.images.camera1", "", "", "left.wide"});

}  // namespace

TEST_CASE("a feature is found by its full name, its alias, and the last part of either") {
  CHECK(*kViews.find("observation.images.top") == 0);
  CHECK(*kViews.find("top") == 0);
  CHECK(*kViews.find("observation.images.camera1") == 0);
  CHECK(*kViews.find("camera1") == 0);
  CHECK(*kViews.find("wide") == 3);
}

TEST_CASE("a whole name goes before the last part of another") {
  const FeatureNames states("state", {"arm.left", "left"}, {"", ""});
  CHECK(*states.find("left") == 1);
  CHECK(*states.find("arm.left") == 0);
}

TEST_CASE("a name that is unknown or shared is refused with the names that there are") {
  for (const char* given : {"", "images.top", "wrist", "bottom"}) {
    CAPTURE(given);
    const auto found = kViews.find(given);
    REQUIRE_FALSE(found.ok());
    CHECK(found.error().code == Code::bad_observation);
    CHECK(found.error().where == "view \"" + std::string(given) + "\"");
    CHECK(found.error().expected == "one of " + kViews.listed());
  }
  CHECK(kViews.find("wrist").error().hint == "give the full name");
}

TEST_CASE("an error's place is the full name, where the name is known") {
  CHECK(kViews.place("camera1") == "observation.images.top");
  CHECK(kViews.place("bottom") == "view \"bottom\"");
}

TEST_CASE("a message lists 50 names at most") {
  const auto listed = [](std::size_t n) {
    const std::vector<std::string> names(n, "x");
    return FeatureNames("view", names, names).listed();
  };
  CHECK(listed(2) == "x, x");
  CHECK(listed(50).find("more") == std::string::npos);
  CHECK(listed(53) == listed(50) + " and 3 more");
}

}  // namespace names_test
