// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Matrices that come through windows of a backend that has no events. Whole policies, and a backend that has them:
// tests/faults/stream_test.py.
#include <doctest/doctest.h>
#include <ggml-cpu.h>

#include "chain.h"
#include "ggml/ggml_device.h"

namespace ggml_stream_test {

using namespace vla;
using test::Chain;

namespace {

/// ggml's CPU as if it were a device with memory of its own.
std::unique_ptr<Device> open(bool keeps_f16, Rounding rounding) {
  set_guard();
  auto device = GgmlDevice::open(ggml_backend_reg_dev_get(ggml_backend_cpu_reg(), 0), "cpu", keeps_f16, rounding);
  REQUIRE_MESSAGE(device.ok(), (device ? "" : device.error().message()));
  // Its threads wait for each other in loops, and have no pool here that puts them to sleep.
  ggml_backend_cpu_set_n_threads(static_cast<GgmlDevice&>(**device).backend(), 1);
  return std::move(*device);
}

}  // namespace

TEST_CASE("matrices of every type that come through a backend's windows give the bits of resident ones") {
  struct Layout {
    DType type;
    bool keeps_f16;
    Rounding rounding;
  };
  constexpr int kDepth = 160;  // large enough to be rounded
  for (const auto& [type, keeps_f16, rounding] : {Layout{DType::f32, false, Rounding::none},
                                                  {DType::f16, false, Rounding::none},
                                                  {DType::f16, true, Rounding::none},
                                                  {DType::bf16, false, Rounding::none},
                                                  {DType::bf16, false, Rounding::bf16},
                                                  {DType::f32, false, Rounding::bf16},
                                                  {DType::ternary, false, Rounding::none}}) {
    CAPTURE(dtype_name(type));
    CAPTURE(static_cast<int>(rounding));
    const Chain chain(type, kDepth);
    test::ChainAnswers resident(chain, open(keeps_f16, rounding), false),
        streamed(chain, open(keeps_f16, rounding), true);
    for (int seed = 0; seed < 4; ++seed) CHECK(streamed.run(seed) == resident.run(seed));
  }
}

}  // namespace ggml_stream_test
