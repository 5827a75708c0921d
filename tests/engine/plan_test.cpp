// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/plan.h"

#include "support/weightless.h"

using namespace vla;
using namespace vla::test;

TEST_CASE("the plans of all robots together stay within one limit, and give way to a new one") {
  const WeightlessSmolVla smolvla(1, "");
  const PlanContext context = smolvla.context();
  const auto all = std::make_shared<std::vector<Plans*>>();
  Plans one(context, all), other(context, all);
  const InputShape first{512, 512, 2, 1, 32};
  REQUIRE(one.for_shape(first).ok());
  std::size_t largest = one.size();
  int n_text = 1;
  for (std::size_t before = 0, size = largest; size > before && n_text < 200;) {
    CHECK(one.find(first) != nullptr);
    REQUIRE((++n_text % 2 == 0 ? other : one).for_shape({512, 512, 2, n_text, 32}).ok());
    before = std::exchange(size, one.size() + other.size());
    largest = std::max(largest, size - std::min(size, before));
    CHECK(size <= (std::size_t{256} << 20) + largest);
  }
  CHECK(n_text < 200);
  CHECK(one.find(first) == nullptr);
  CHECK((n_text % 2 == 0 ? one : other).size() == 0);
}
