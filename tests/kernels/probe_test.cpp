// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Rates depend on the machine and on what else it does, so that only what holds on any machine is asked for.
#include "kernels/probe/probe.h"

#include <doctest/doctest.h>

#include <algorithm>

using namespace vla;
using namespace vla::kernels;

TEST_CASE("every probe of this machine returns a rate that a processor can have, on one thread and on two") {
  REQUIRE(!peak_probes().empty());
  for (const PeakProbe& probe : peak_probes()) {
    CAPTURE(probe.name);
    const double one = measure_peak(probe, 1, 0.02), two = measure_peak(probe, 2, 0.02);
    CHECK(one > 1e8);   // a tenth of a multiply-add per nanosecond
    CHECK(one < 1e15);  // a loop that the compiler removed would be faster than this
    CHECK(two >= 0.5 * one);
  }
}

TEST_CASE("wider instructions multiply faster: avx2 beats the baseline where both are there") {
  const auto& probes = peak_probes();
  const auto avx2 = std::find_if(probes.begin(), probes.end(), [](const auto& p) { return p.isa == Isa::avx2; });
  if (avx2 == probes.end()) {
    MESSAGE("skipped: this machine has no AVX2");
    return;
  }
  CHECK(measure_peak(*avx2, 1, 0.05) > measure_peak(probes.front(), 1, 0.05));
}

TEST_CASE("the peak of a choice of kernels is in floating point, and in float32 for ggml") {
  for (Isa isa : usable_isas()) {
    const PeakProbe& probe = peak_probe_of(isa);
    CHECK(probe.number != Number::int8);
    CHECK((isa == Isa::ggml ? probe.number == Number::f32 : probe.isa == isa));
  }
}

TEST_CASE("memory is read at a rate that a machine can have") {
  const double rate = measure_read_bandwidth(2, 0.02);
  CHECK(rate > 1e8);
  CHECK(rate < 1e13);
}
