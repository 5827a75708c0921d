// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// A program finds its matrices by their index in a table when a run begins.
#include <doctest/doctest.h>

#include <cstring>

#include "lower/cpu/cpu_device.h"
#include "lower_case.h"

namespace weight_table_test {

using namespace vla;

namespace {

/// A matrix in memory of its own.
struct Elsewhere {
  explicit Elsewhere(std::size_t size) : memory(*lower::Memory::allocate(size, "a matrix")) {}
  lower::Memory memory;
};

}  // namespace

TEST_CASE("a matrix may lie elsewhere in the next run, and the result is the same to the bit") {
  for (const KernelSet& set : test::lowered_kernels()) {
    CAPTURE(set.name);
    const test::LowerParams params;
    auto opened = lower::CpuDevice::open(2, *Arithmetic::on_cpu(set.name, this_cpu()));
    REQUIRE(opened.ok());
    auto& device = static_cast<lower::CpuDevice&>(**opened);
    REQUIRE(device.load(params.list(), true).ok());
    Slots slots;
    Slot *x = slots.add_f32({35, 3, 1, 1}), *y = slots.add_f32({67, 3, 1, 1});
    REQUIRE(device.allocate(slots).ok());
    Graph g(slots);
    g.write(params.linear(g, g.input(x), 67), y);
    const auto program = device.lower(g, {});
    REQUIRE(program.ok());
    const std::vector<float> rows = test::ramp(105, 1.0f);
    device.set(*x, rows.data(), x->size());
    REQUIRE((*program)->run().ok());
    const std::vector<float> expected = static_cast<const Device&>(device).get(*y);
    CHECK(expected[0] != 0);

    const Param& matrix = params.list().params().front();
    lower::WeightTable& table = *device.weights().table();
    auto& [data, scales] = table.entries[static_cast<std::size_t>(matrix.id)];
    const std::size_t size = device.weights().kernel(&matrix)->packed_size({DType::f32, 35, 67});
    const Elsewhere other(size);
    std::memcpy(other.memory.data(), data, size);
    std::memset(data, 0xFF, size);  // NaN, for whoever reads it there
    data = other.memory.data(), ++table.version;
    REQUIRE((*program)->run().ok());
    CHECK(static_cast<const Device&>(device).get(*y) == expected);
  }
}

}  // namespace weight_table_test
