// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/description.h"

#include <doctest/doctest.h>

#include "support/editable_bundle.h"
#include "support/golden_case.h"

namespace description_test {

using namespace vla;
using namespace vla::test;

TEST_CASE("a description states features, chunk and solver of a bundle that pads its actions") {
  const auto engine = load_engine(golden_path("smolvla/absent_view/bundle.gguf"));
  const Description d = describe(*engine, engine->robot());
  CHECK(d.arch == "smolvla");
  REQUIRE(d.views.size() == 4);
  CHECK(d.views[2].name == "observation.images.base");
  CHECK(d.views[2].alias == "observation.images.left");
  CHECK_FALSE(d.views[2].optional);
  CHECK(d.views[3].optional);
  REQUIRE(d.states.size() == 1);
  CHECK(d.states[0].numbers.size() == 3);
  CHECK(d.actions.size() == 4);
  CHECK(d.horizon == 9);
  CHECK(d.noise == "normal");
  CHECK(d.n_step == 6);
}

TEST_CASE("a robot that gets the first rows and columns only: the chunk is smaller than the solver's start") {
  const auto engine = load_engine(golden_path("gr00t_n1_7/libero/bundle.gguf"));
  const Description d = describe(*engine, engine->robot());
  CHECK(d.horizon == 5);
  CHECK(d.noise_rows == 8);
  CHECK(d.actions.size() == 7);
  CHECK(d.d_action_padded == 11);
  CHECK(d.states.size() == 7);
}

}  // namespace description_test
