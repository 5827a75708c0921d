// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The least memory that published policies are told to need, of which nothing is filled or computed.
#include <doctest/doctest.h>

#include <cstdlib>
#include <set>

#include "devices/devices.h"
#include "engine/plan.h"
#include "engine/robot.h"
#include "kernels/kernel_set.h"
#include "lower/cuda/cuda_device.h"
#include "policies/policy.h"
#include "support/published.h"

namespace budget_test {

using namespace vla;

namespace {

using OpenDevice = std::function<Result<std::unique_ptr<Device>>()>;

class DryPolicy {
 public:
  DryPolicy(const Bundle& bundle, const OpenDevice& open) {
    auto robot = Robot::open(bundle, nullptr);
    REQUIRE_MESSAGE(robot.ok(), (robot ? "" : robot.error().message()));
    robot_ = std::move(*robot);
    auto device = open();
    REQUIRE_MESSAGE(device.ok(), (device ? "" : device.error().message()));
    device_ = std::move(*device);
  }

  Device& device() { return *device_; }
  /// Loads with this plan.
  Status load(const WeightPlan& plan) {
    VLA_CHECK(device_->load(robot_->params(), false, plan));
    return robot_->compute_constants({*device_, {}, true});
  }
  Result<std::unique_ptr<Plan>> plan_for(const InputShape& shape) {
    return Plan::build(robot_->network(), shape, {*device_, "", true});
  }
  InputShape largest() const { return robot_->largest_shape(); }
  /// Of other observations: of a word, of one view, of a chunk to continue.
  std::vector<InputShape> others() const {
    std::vector<InputShape> all;
    const auto add = [&](const auto& change) {
      InputShape shape = largest();
      change(shape);
      if (robot_->network().policy.check(shape).ok()) all.push_back(shape);
    };
    add([](InputShape& shape) { shape.n_text = std::max(std::min(1, shape.n_text), shape.n_text - 47); });
    add([](InputShape& shape) { shape.n_view = 1, shape.views &= 1; });
    if (robot_->real_time_chunking().kind != RealTimeChunking::Kind::none)
      add([](InputShape& shape) { shape.steered = true; });
    return all;
  }

 private:
  std::unique_ptr<Robot> robot_;
  std::unique_ptr<Device> device_;
};

void check_ok(const Status& status) { REQUIRE_MESSAGE(status.ok(), (status.ok() ? "" : status.error().message())); }

/// With the least that is planned, every program of the policy is made, and takes what was planned.
void check_least(const Bundle& bundle, const OpenDevice& open) {
  DryPolicy policy(bundle, open);
  Device& device = policy.device();
  if (const Status status = policy.load({}); !status.ok()) {
    REQUIRE(status.error().code == Code::unsupported);  // nothing is rounded
    return;
  }
  WeightPlan least;
  std::size_t working = 0;
  {
    const auto largest = policy.plan_for(policy.largest());
    REQUIRE_MESSAGE(largest.ok(), (largest ? "" : largest.error().message()));
    least = *device.plan_weights((*largest)->prefix(), (*largest)->step(), 0);
    working = device.working_size();
    CHECK(least.smallest <= device.weights_size());
  }
  check_ok(policy.load(least));
  CHECK(device.weights_size() == least.smallest);
  const auto largest = policy.plan_for(policy.largest());
  REQUIRE_MESSAGE(largest.ok(), (largest ? "" : largest.error().message()));
  CHECK(device.working_size() == working);
  for (const InputShape& shape : policy.others()) {
    const auto plan = policy.plan_for(shape);
    CHECK_MESSAGE(plan.ok(), (plan ? "" : plan.error().message()));
  }
}

bool tries_all() { return std::getenv("VLA_ALL_BUDGETS") != nullptr; }

/// What matrices are rounded to, and with VLA_ALL_BUDGETS all that multiplies them on this machine.
std::vector<std::string> some_kernels() {
  if (!tries_all()) return {"", "portable", "int8", "int4"};
  std::vector<std::string> names = {"", "float32", "int8", "int4"};
  if (rounds_to_bf16(usable_kernels().back())) names.emplace_back("bf16");
  for (const KernelSet& set : usable_kernels())
    if (set != kernel_set::ggml) names.emplace_back(set.name);
  return names;
}

/// All with VLA_ALL_BUDGETS. Without it in bf16, and small ones in other dtypes: a file of 30 GB takes seconds to read.
bool is_tried(const std::string& arch, const std::string& stored) {
  static const std::set<std::string> kSmall = {"act", "smolvla"};
  return stored == "bf16" || kSmall.contains(arch) || tries_all();
}

/// All values with VLA_ALL_BUDGETS. Without it one, which is not the same for each policy.
template <class T>
std::vector<T> some(const std::vector<T>& values, std::size_t policy) {
  return tries_all() ? values : std::vector<T>{values[policy % values.size()]};
}

void check_on_each_device(const PolicyEntry& entry, const std::string& stored, std::size_t policy) {
  const auto file = test::PublishedBundle::make(entry, stored);
  REQUIRE_MESSAGE(file.ok(), (file ? "" : file.error().message()));
  const auto bundle = Bundle::open(file->path());
  REQUIRE(bundle.ok());
  for (const std::string& kernels : some(some_kernels(), policy)) {
    CAPTURE(kernels);
    check_least(*bundle, [&] { return open_device(2, kernels); });
  }
  for (const Rounding rounding : some<Rounding>({Rounding::none, Rounding::int8, Rounding::float32}, policy))
    check_least(*bundle, [&] { return lower::CudaDevice::model("orin-agx", rounding); });
}

}  // namespace

TEST_CASE("the least memory that a published policy is told to need suffices for each of its programs") {
  std::size_t policy = 0;
  for (const std::string stored : {"bf16", "f32", "int8", "int4"})
    for (const PolicyEntry& entry : policy_registry()) {
      CAPTURE(stored);
      CAPTURE(entry.name);
      if (is_tried(entry.name, stored)) check_on_each_device(entry, stored, policy++);
    }
}

}  // namespace budget_test
