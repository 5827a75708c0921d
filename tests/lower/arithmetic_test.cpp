// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/arithmetic.h"

#include <doctest/doctest.h>

namespace arithmetic_test {

using namespace vla;

namespace {

using Backend = Arithmetic::Backend;

/// Processors that differ in what they have, from nothing to everything.
const Features kMachines[] = {
    {Feature::baseline},
    {Feature::baseline, Feature::neon},
    kernel_set::neon_bf16.uses.with(Feature::baseline),
    {Feature::baseline, Feature::avx2},
    {Feature::baseline, Feature::avx2, Feature::avx_vnni},
    {Feature::baseline, Feature::avx2, Feature::avx512},
    kernel_set::avx512.uses.with(Feature::baseline),
    kernel_set::avx512_bf16.uses.with(Feature::baseline),
    kernel_set::amx.uses.with(Feature::baseline),
};

}  // namespace

TEST_CASE("every set that a processor can run is chosen by its name, with what the processor has, and others refused") {
  for (const Features machine : kMachines)
    for (const KernelSet& set : kernel_set::all) {
      const auto chosen = Arithmetic::on_cpu(set.name, machine);
      CAPTURE(set.name);
      REQUIRE(chosen.ok() == machine.has_all(set.needs));
      if (!chosen) {
        CHECK(chosen.error().code == Code::device);
        CHECK(chosen.error().found == set.name);
        continue;
      }
      CHECK(chosen->use.has_all(set.needs));
      CHECK(machine.has_all(chosen->use));
      CHECK(set.uses.has_all(chosen->use));
      CHECK((chosen->backend == Backend::ggml) == (set == kernel_set::ggml));
      CHECK(chosen->at_load == Rounding::none);
    }
}

TEST_CASE("no name takes the best, float32 the best that does not round, and bf16 and int8 the best with rounding") {
  for (const Features machine : kMachines) {
    const KernelSet best = kernel_set_of(machine);
    CHECK(kernel_set_of(Arithmetic::on_cpu("", machine)->use) == best);
    const auto floats = Arithmetic::on_cpu("float32", machine);
    CHECK_FALSE(rounds_to_bf16(floats->use));
    const KernelSet& exact = best == kernel_set::neon_bf16 ? kernel_set::neon : kernel_set::avx512;
    CHECK(kernel_set_of(floats->use) == (rounds_to_bf16(best) ? exact : best));
    const auto bf16 = Arithmetic::on_cpu("bf16", machine), int8 = Arithmetic::on_cpu("int8", machine);
    REQUIRE(bf16.ok() == rounds_to_bf16(best));
    if (bf16) CHECK((bf16->at_load == Rounding::bf16 && kernel_set_of(bf16->use) == best));
    CHECK((int8->at_load == Rounding::int8 && kernel_set_of(int8->use) == best));
  }
}

TEST_CASE("an unknown name is refused with the names that there are, on every device") {
  const auto cpu = Arithmetic::on_cpu("sse2", this_cpu()), gpu = Arithmetic::on_device("avx2", "cuda:0");
  REQUIRE_FALSE((cpu.ok() || gpu.ok()));
  CHECK(cpu.error().code == Code::usage);
  CHECK(cpu.error().expected.find("avx2") != std::string::npos);
  CHECK(cpu.error().found == "sse2");
  CHECK(gpu.error().expected.find("cuda:0") != std::string::npos);
}

TEST_CASE("on CUDA our own kernels compute unless ggml is asked for, on Vulkan ggml's alone, which has no codes") {
  const auto own = Arithmetic::Backend::own, ggml = Arithmetic::Backend::ggml;
  const auto is = [](const char* kernels, const char* device, Arithmetic::Backend backend, Rounding at_load) {
    const auto found = Arithmetic::on_device(kernels, device);
    return found.ok() && found->backend == backend && found->at_load == at_load;
  };
  CHECK(is("", "cuda:1", own, Rounding::none));
  CHECK(is("float32", "cuda:0", own, Rounding::float32));
  CHECK(is("bf16", "cuda:0", own, Rounding::bf16));
  CHECK(is("int8", "cuda:0", own, Rounding::int8));
  CHECK(is("int4", "cuda:0", own, Rounding::int4));
  CHECK(is("ggml", "cuda:0", ggml, Rounding::none));
  CHECK(is("", "vulkan:0", ggml, Rounding::none));
  CHECK(is("float32", "vulkan:0", ggml, Rounding::none));
  CHECK(is("bf16", "vulkan:0", ggml, Rounding::bf16));
  CHECK(is("ggml", "vulkan:0", ggml, Rounding::none));
  for (const char* codes : {"int8", "int4"}) CHECK(!Arithmetic::on_device(codes, "vulkan:0").ok());
}

TEST_CASE("features that other features imply are never there without them") {
  CHECK(kernel_sets(this_cpu()).front() == kernel_set::ggml);
  CHECK(this_cpu().has(Feature::baseline));
  CHECK(this_cpu().has(Feature::avx512) >= this_cpu().has(Feature::avx512_vnni));
  CHECK(this_cpu().has(Feature::amx_bf16) >= this_cpu().has(Feature::amx_int8));
  CHECK(this_cpu().has(Feature::dotprod) >= this_cpu().has(Feature::i8mm));
}

}  // namespace arithmetic_test
