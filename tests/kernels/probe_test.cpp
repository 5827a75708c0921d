// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Rates depend on the machine and on what else it does, so that only what holds on any machine is asked for.
#include "kernels/probe/probe.h"

#include <doctest/doctest.h>

namespace probe_test {

using namespace vla;
using namespace vla::kernels;

TEST_CASE("every probe of this machine returns a rate that a processor can have, on one thread and on two") {
  REQUIRE(!peak_probes().empty());
  for (const PeakProbe& probe : peak_probes()) {
    CAPTURE(probe.name);
    const double one = measure_peak(probe, 1, 0.02), two = measure_peak(probe, 2, 0.02);
    for (double rate : {one, two}) {
      CHECK(rate > 1e5);  // threads that wait for each other's core in a busy machine are slow, but not as slow as this
      CHECK(rate < 1e15);  // a loop that the compiler removed would be faster than this
    }
  }
}

TEST_CASE("the peak of a choice of kernels is in floating point, and in float32 for ggml") {
  for (const KernelSet& set : usable_kernels()) {
    const PeakProbe& probe = peak_probe_of(set.uses);
    CHECK(probe.number != Number::int8);
    CHECK((set == kernel_set::ggml ? probe.number == Number::f32 : set.uses.has_all(probe.needs)));
  }
}

TEST_CASE("memory is read at a rate that a machine can have") {
  const double rate = measure_read_bandwidth(2, 0.02);
  CHECK(rate > 1e5);
  CHECK(rate < 1e13);
}

}  // namespace probe_test
