// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Random graphs, whose operations read matrices in any order and more than once, with as few of them in memory as can
// be.
#include <doctest/doctest.h>

#include <random>

#include "lower/cpu/cpu_device.h"
#include "lower_case.h"

using namespace vla;
using namespace vla::lower;

namespace {

constexpr int kDepth = 64, kMatrices = 16, kRows = 5;

class Matrices {
 public:
  explicit Matrices(DType type) : set_(pieces(type)) {
    for (int i = 0; i < kMatrices; ++i) all_.push_back(set_.scope().matrix(name(i), kDepth, kDepth));
  }
  const ParamList& list() const { return set_.list(); }
  const Param* operator[](std::size_t i) const { return all_[i]; }

 private:
  static std::string name(int i) { return "w" + std::to_string(i); }
  static std::vector<test::ParamSet::Piece> pieces(DType type) {
    std::vector<test::ParamSet::Piece> pieces;
    for (int i = 0; i < kMatrices; ++i)
      pieces.push_back({name(i),
                        {kDepth, kDepth},
                        test::ramp(std::size_t{kDepth} * kDepth, 0.2f + 0.01f * static_cast<float>(i)),
                        type});
    return pieces;
  }

  test::ParamSet set_;
  std::vector<const Param*> all_;
};

/// Products of earlier values, each of one, two or three matrices, some of gate and up.
Tensor record(Graph& g, const Matrices& matrices, Tensor x, Tensor fixed, unsigned seed) {
  std::mt19937 random(seed);
  const auto pick = [&](std::size_t n) { return static_cast<std::size_t>(random()) % n; };
  std::vector<Tensor> values = {x, fixed};
  const auto product = [&](Tensor of) { return g.add(op::Linear{matrices[pick(kMatrices)], nullptr}, {of}); };
  const auto bounded = [&](Tensor of) { return g.add(op::Activate{Activation::gelu_tanh}, {of}); };
  for (int i = 0; i < 24; ++i) {
    const Tensor of = values[pick(values.size())];
    switch (pick(4)) {
      case 0:
        values.push_back(multiply(g, bounded(product(of)), product(of)));
        break;
      case 1:
        values.push_back(bounded(add(g, product(of), values[pick(values.size())])));
        break;
      default: {
        std::vector<Tensor> side;
        for (std::size_t n = 1 + pick(4); side.size() < n;) side.push_back(product(of));
        for (const Tensor one : side) values.push_back(bounded(one));
      }
    }
  }
  Tensor sum = values[0];
  for (const Tensor value : values) sum = add(g, sum, value);
  return sum;
}

/// A device with programs of random graphs: one that a plan is made from, a step, and others.
class RandomPrograms {
 public:
  RandomPrograms(const Matrices& matrices, const KernelSet& set, unsigned seed, const WeightPlan& plan)
      : matrices_(matrices), device_(std::move(*CpuDevice::open(2, *Arithmetic::on_cpu(set.name, this_cpu())))) {
    REQUIRE(device_->load(matrices_.list(), true, plan).ok());
    for (Slot** slot : {&x_, &fixed_, &y_}) *slot = slots_.add_f32({kDepth, kRows, 1, 1});
    REQUIRE(device_->allocate(slots_).ok());
    programs_.push_back(lower(seed));
    working_ = device_->working_size();
    for (unsigned i = 1; i < 4; ++i) programs_.push_back(lower(seed + i));
    Graph step(slots_);
    step.write(step.add(op::Linear{matrices_[0], nullptr}, {step.input(x_)}), y_);
    step_ = std::move(*device_->lower(step, {}));
  }
  WeightPlan least() const { return *device_->plan_weights(*programs_[0], *step_, 0); }
  std::size_t weights_size() const { return device_->weights_size(); }
  /// Of the program that a plan is made from.
  std::size_t working() const { return working_; }

  std::vector<float> run() {
    std::vector<float> all;
    const std::vector<float> rows = test::ramp(std::size_t{kDepth} * kRows, 1);
    for (const Slot* slot : {x_, fixed_}) device_->set(*slot, rows.data(), slot->size());
    for (int round = 0; round < 2; ++round)
      for (const auto& program : programs_) {
        REQUIRE(program->prepare().ok());
        REQUIRE(program->run().ok());
        for (const float value : device_->get(*y_)) all.push_back(value);
      }
    return all;
  }

 private:
  std::unique_ptr<Program> lower(unsigned seed) {
    Graph g(slots_);
    g.write(record(g, matrices_, g.input(x_), g.input(fixed_), seed), y_);
    auto program = device_->lower(g, {{x_}});
    REQUIRE_MESSAGE(program.ok(), (program ? "" : program.error().message()));
    return std::move(*program);
  }

  const Matrices& matrices_;
  std::size_t working_ = 0;
  std::unique_ptr<Device> device_;
  Slots slots_;
  Slot *x_ = nullptr, *fixed_ = nullptr, *y_ = nullptr;
  std::vector<std::unique_ptr<Program>> programs_;
  std::unique_ptr<Program> step_;
};

}  // namespace

TEST_CASE("graphs of any order run with the least memory that is planned for one of them, to the same bits") {
  int n_streamed = 0;
  for (const KernelSet& set : test::lowered_kernels())
    for (const DType type : {DType::f32, DType::bf16}) {
      const Matrices matrices(type);
      for (unsigned seed = 0; seed < 60; seed += 4) {
        CAPTURE(set.name);
        CAPTURE(seed);
        RandomPrograms resident(matrices, set, seed, {});
        const WeightPlan plan = resident.least();
        RandomPrograms streamed(matrices, set, seed, plan);
        n_streamed += plan.streamed.empty() ? 0 : 1;
        CHECK(streamed.weights_size() == plan.smallest);
        CHECK(streamed.working() == resident.working());
        CHECK(streamed.run() == resident.run());
      }
    }
  CHECK(n_streamed > 20);
}
