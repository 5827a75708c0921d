// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/plan.h"

#include "support/weightless.h"

namespace plan_test {

using namespace vla;
using namespace vla::test;

TEST_CASE("the plans of all robots together stay within one limit, and give way to a new one") {
  const WeightlessSmolVla smolvla(1, "");
  const Network one = smolvla.network(), other = smolvla.other_robot();
  Plans plans = smolvla.plans();
  const InputShape first{.width = 512, .height = 512, .n_view = 2, .n_text = 1, .d_state = 32};
  REQUIRE(plans.for_shape(one, first).ok());
  CHECK(plans.find(other, first) == nullptr);
  std::size_t largest = plans.size();
  int n_text = 1;
  for (std::size_t before = 0, size = largest; size > before && n_text < 200;) {
    CHECK(plans.find(one, first) != nullptr);
    const auto plan = plans.for_shape(++n_text % 2 == 0 ? other : one, {512, 512, 2, n_text, 32});
    REQUIRE(plan.ok());
    before = std::exchange(size, plans.size());
    largest = std::max(largest, (*plan)->size());
    CHECK(size <= (std::size_t{256} << 20) + largest);
  }
  CHECK(n_text < 200);
  CHECK(plans.find(one, first) == nullptr);
  CHECK(plans.size() == largest);  // of the plan that the others gave way to
}

}  // namespace plan_test
