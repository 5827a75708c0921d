// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Whole policies on our own kernels for CUDA through the fake driver. `open_device` of this program hands out that
// device in the place of the CPU's kernels in float32.
#include <doctest/doctest.h>

#include <cstdlib>

#include "cuda/fake_driver.h"
#include "cuda/machine.h"
#include "devices/devices.h"
#include "lower/cuda/cuda_device.h"
#include "support/golden_case.h"

using namespace vla;
using namespace vla::test;

namespace vla {

// Of the linker: `--wrap` gives these names to what calls open_device(), and to that itself.
Result<std::unique_ptr<Device>> real_open_device(int, const std::string&, const std::string&) asm(
    "__real__ZN3vla11open_deviceEiRKNSt7__cxx1112basic_stringIcSt11char_traitsIcESaIcEEES7_");
Result<std::unique_ptr<Device>> wrapped_open_device(int, const std::string&, const std::string&) asm(
    "__wrap__ZN3vla11open_deviceEiRKNSt7__cxx1112basic_stringIcSt11char_traitsIcESaIcEEES7_");

Result<std::unique_ptr<Device>> wrapped_open_device(int n_thread, const std::string& kernels,
                                                    const std::string& device) {
  if (kernels == "ggml") return real_open_device(n_thread, kernels, device);
  return lower::CudaDevice::open(test::cuda::fake_driver_table(), 0, test::cuda::modules_of_tests());
}

}  // namespace vla

TEST_CASE("policies on our own kernels for CUDA match the reference at every tap within 1e-4") {
  const bool all = std::getenv("VLA_ALL_FAMILIES") != nullptr;
  for (const std::string& path : golden_paths()) {
    const bool is_ternary = path.find("/bitvla/") != path.npos;
    if (is_ternary || (!all && path.find("/smolvla/") == path.npos)) continue;
    CAPTURE(path);
    test::cuda::reset_fake_driver();
    const GoldenCase golden = GoldenCase::read(path);
    const auto engine = load_engine(golden.bundle(), "*", "float32");
    const auto chunk = engine->act(golden.observation, golden.noise);
    REQUIRE_MESSAGE(chunk.ok(), (chunk ? "" : chunk.error().message() + test::cuda::fake_driver().fault));
    for (const Tap& expected : golden.expected()) {
      if (expected.path == "chunk.bf16" || expected.path.starts_with("position_ids")) continue;
      const auto difference = compare_taps({expected}, {find_tap(chunk->taps, expected.path)}).front();
      CAPTURE(expected.path);
      CAPTURE(difference.relative);
      CHECK(difference.within(1e-4));
    }
  }
}
