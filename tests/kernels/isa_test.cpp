// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/isa.h"

#include <doctest/doctest.h>

#include <algorithm>

using namespace vla;

TEST_CASE("every usable instruction set can be chosen by its name, and no name means the best") {
  REQUIRE(usable_isas().front() == Isa::ggml);
  for (Isa isa : usable_isas()) {
    const auto chosen = choose_isa(isa_name(isa));
    REQUIRE(chosen.ok());
    CHECK(*chosen == isa);
  }
  CHECK(*choose_isa("") == usable_isas().back());
}

TEST_CASE("float32 means the best that does not round to bf16") {
  const auto best =
      std::find_if(usable_isas().rbegin(), usable_isas().rend(), [](Isa isa) { return !rounds_to_bf16(isa); });
  CHECK(*choose_isa("float32") == *best);
}

TEST_CASE("bf16 means the best that rounds to it, and is refused where nothing does") {
  const auto chosen = choose_isa("bf16");
  REQUIRE(chosen.ok() == rounds_to_bf16(usable_isas().back()));
  if (chosen.ok())
    CHECK(*chosen == usable_isas().back());
  else
    CHECK(chosen.error().code == Code::device);
}

TEST_CASE("an unknown kernel name is refused with the names that there are") {
  const auto chosen = choose_isa("sse2");
  REQUIRE_FALSE(chosen.ok());
  CHECK(chosen.error().code == Code::usage);
  CHECK(chosen.error().expected.find("avx2") != std::string::npos);
  CHECK(chosen.error().found == "sse2");
}

TEST_CASE("kernels that this machine lacks are refused, not replaced") {
  for (Isa isa : {Isa::avx2, Isa::avx512, Isa::avx512_bf16, Isa::amx}) {
    if (std::find(usable_isas().begin(), usable_isas().end(), isa) != usable_isas().end()) continue;
    const auto chosen = choose_isa(isa_name(isa));
    REQUIRE_FALSE(chosen.ok());
    CHECK(chosen.error().code == Code::device);
    CHECK(chosen.error().found == isa_name(isa));
  }
}
