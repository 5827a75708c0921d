// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include "devices/devices.h"
#include "engine/plan.h"

namespace vla::test {

/// The published SmolVLA as far as plans need it: its weights are memory that is never touched.
struct WeightlessSmolVla {
  WeightlessSmolVla(int n_step, const std::string& kernels) {
    REQUIRE(list.report("smolvla", {}).ok());
    solver.n_step = n_step;
    solver.times.assign(static_cast<std::size_t>(n_step), {1.0f, 1.0});
    auto opened = open_device(1, kernels);
    REQUIRE(opened.ok());
    device = std::move(*opened);
    REQUIRE(device->load(list, false).ok());
    conditions = tables.add_f32({720, n_step, 1, 1});
    REQUIRE(device->allocate(tables).ok());
  }

  Network network() const { return {*policy, solver, conditions, constants, 32, 50}; }
  Network other_robot() const { return {*other, solver, conditions, constants, 32, 50}; }
  Plans plans() const { return Plans({*device, "", true}); }

  PolicyEntry entry = *find_policy("smolvla");
  Keys keys = entry.published();
  ParamList list{keys, nullptr};
  std::unique_ptr<Policy> policy = entry.make(list), other = entry.make(list);
  std::unique_ptr<Device> device;
  Solver solver;
  Slots tables;
  const Slot* conditions = nullptr;
  Cache constants;
};

}  // namespace vla::test
