// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/view_places.h"

#include <doctest/doctest.h>

#include <tuple>

namespace view_places_test {

using namespace vla;

namespace {

struct Made {
  ViewPlaces places;
  bool sound;
};

Made make(const std::string& key, std::vector<std::int64_t> counts, int n_view_token, ViewPlaces::Count count) {
  const Keys keys({{"policy.max_views", static_cast<std::int64_t>(2)}, {key, std::move(counts)}});
  ParamList list(keys, nullptr);
  ViewPlaces places(Scope(list, ""), n_view_token, count);
  return {std::move(places), list.report("test", {}).ok()};
}

std::vector<std::tuple<int, int, int>> pieces(const ViewPlaces& places, int n_token) {
  std::vector<std::tuple<int, int, int>> found;
  for (const PromptPiece& piece : places.pieces(n_token)) found.emplace_back(piece.first, piece.count, piece.slot);
  return found;
}

constexpr auto kStart = ViewPlaces::Count::from_start, kEnd = ViewPlaces::Count::from_end;
constexpr int kText = PromptPiece::kText;

}  // namespace

TEST_CASE("views in front of the instruction stay where they are, whatever its length") {
  const auto [places, sound] = make("policy.view_starts", {2, 5}, 3, kStart);
  REQUIRE(sound);
  using Pieces = std::vector<std::tuple<int, int, int>>;
  CHECK(pieces(places, 10) == Pieces{{0, 2, kText}, {2, 3, 0}, {5, 3, 1}, {8, 2, kText}});
  CHECK(pieces(places, 8) == Pieces{{0, 2, kText}, {2, 3, 0}, {5, 3, 1}});
  CHECK(places.check(2, 8).ok());
  CHECK_FALSE(places.check(2, 7).ok());
  CHECK_FALSE(places.check(1, 8).ok());
}

TEST_CASE("views behind the instruction are counted from the end of the prompt") {
  const auto [places, sound] = make("policy.view_starts_from_end", {9, 5}, 3, kEnd);
  REQUIRE(sound);
  using Pieces = std::vector<std::tuple<int, int, int>>;
  CHECK(places.starts(12) == std::vector<int>{3, 7});
  CHECK(pieces(places, 12) == Pieces{{0, 3, kText}, {3, 3, 0}, {6, 1, kText}, {7, 3, 1}, {10, 2, kText}});
  CHECK(places.check(2, 10).ok());
  CHECK_FALSE(places.check(2, 9).ok());  // the first token would be a image's
}

TEST_CASE("views that overlap, or stand where no text is in front of them, are refused") {
  CHECK_FALSE(make("policy.view_starts", {0, 5}, 3, kStart).sound);
  CHECK_FALSE(make("policy.view_starts", {2, 4}, 3, kStart).sound);
  CHECK_FALSE(make("policy.view_starts", {2}, 3, kStart).sound);
  CHECK_FALSE(make("policy.view_starts_from_end", {7, 5}, 3, kEnd).sound);
  CHECK_FALSE(make("policy.view_starts_from_end", {9, 2}, 3, kEnd).sound);
}

}  // namespace view_places_test
