// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Random graphs, whose operations read matrices in any order and more than once, with as few of them in memory as can
// be.
#include <doctest/doctest.h>

#include <random>

#include "lower/cpu/cpu_device.h"
#include "lower_case.h"

namespace stream_order_test {

using namespace vla;
using namespace vla::lower;

namespace {

// Deep enough that int8 and int4 round matrices. Pairs are a product into a wider value and one back.
constexpr int kDepth = 144, kMatrices = 16, kPairs = 6, kRows = 5;
constexpr unsigned kGraphs = 3;
constexpr int width_of(int pair) { return kDepth + 64 * pair; }

class Matrices {
 public:
  struct Pair {
    const Param *up, *down;
  };

  explicit Matrices(DType type) : set_(pieces(type)) {
    const Scope s = set_.scope();
    for (int i = 0; i < kMatrices; ++i) all_.push_back(s.matrix(name("w", i), kDepth, kDepth));
    for (int i = 0; i < kPairs; ++i)
      pairs_.push_back({s.matrix(name("up", i), kDepth, width_of(i)), s.matrix(name("down", i), width_of(i), kDepth)});
  }
  const ParamList& list() const { return set_.list(); }
  const Param* operator[](std::size_t i) const { return all_[i]; }
  const Pair& pair(std::size_t i) const { return pairs_[i]; }

 private:
  static std::string name(const std::string& of, int i) { return of + std::to_string(i); }
  static test::ParamSet::Piece piece(const std::string& name, std::int64_t d_in, std::int64_t d_out, float largest,
                                     DType type) {
    return {name, {d_in, d_out}, test::ramp(static_cast<std::size_t>(d_in * d_out), largest), type};
  }
  static std::vector<test::ParamSet::Piece> pieces(DType type) {
    std::vector<test::ParamSet::Piece> pieces;
    for (int i = 0; i < kMatrices; ++i)
      pieces.push_back(piece(name("w", i), kDepth, kDepth, 0.1f + 0.01f * static_cast<float>(i), type));
    for (int i = 0; i < kPairs; ++i) {
      pieces.push_back(piece(name("up", i), kDepth, width_of(i), 0.1f, type));
      pieces.push_back(piece(name("down", i), width_of(i), kDepth, 0.1f, type));
    }
    return pieces;
  }

  test::ParamSet set_;
  std::vector<const Param*> all_;
  std::vector<Pair> pairs_;
};

/// Products of earlier values, each of one to four matrices, some of gate and up, some into a wider value and back.
Tensor record(Graph& g, const Matrices& matrices, Tensor x, Tensor fixed, unsigned seed) {
  std::mt19937 random(seed);
  const auto pick = [&](std::size_t n) { return static_cast<std::size_t>(random()) % n; };
  std::vector<Tensor> values = {x, fixed};
  const auto product = [&](Tensor of) { return g.add(op::Linear{matrices[pick(kMatrices)], nullptr}, {of}); };
  const auto bounded = [&](Tensor of) { return g.add(op::Activate{Activation::gelu_tanh}, {of}); };
  for (int i = 0; i < 24; ++i) {
    const Tensor of = values[pick(values.size())];
    switch (pick(5)) {
      case 0:
        values.push_back(multiply(g, bounded(product(of)), product(of)));
        break;
      case 1:
        values.push_back(bounded(add(g, product(of), values[pick(values.size())])));
        break;
      case 2: {
        const Matrices::Pair& pair = matrices.pair(pick(kPairs));
        const Tensor wide = bounded(g.add(op::Linear{pair.up, nullptr}, {of}));
        values.push_back(bounded(g.add(op::Linear{pair.down, nullptr}, {wide})));
        break;
      }
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
  RandomPrograms(const Matrices& matrices, const std::string& kernels, unsigned seed, const WeightPlan& plan)
      : matrices_(matrices), device_(std::move(*CpuDevice::open(2, *Arithmetic::on_cpu(kernels, this_cpu())))) {
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
  WeightPlan plan(std::size_t budget) const { return *device_->plan_weights(*programs_[0], *step_, budget); }
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

/// Runs the programs with the least memory and with some more, and returns how many of the two read from the file.
int check_budgets(const Matrices& matrices, const std::string& kernels, unsigned seed) {
  RandomPrograms resident(matrices, kernels, seed, {});
  const std::vector<float> expected = resident.run();
  const std::size_t least = resident.plan(0).smallest;
  int n_streamed = 0;
  for (const std::size_t budget : {least, (least + resident.weights_size()) / 2}) {
    const WeightPlan plan = resident.plan(budget);
    n_streamed += plan.streamed.empty() ? 0 : 1;
    CHECK(plan.smallest == least);
    RandomPrograms streamed(matrices, kernels, seed, plan);
    CHECK(streamed.weights_size() <= budget);
    CHECK(streamed.working() == resident.working());
    CHECK(streamed.run() == expected);
  }
  return n_streamed;
}

}  // namespace

TEST_CASE("graphs of any order run with the least memory that is planned for one of them, to the same bits") {
  std::vector<std::string> names = {"int8", "int4"};
  if (rounds_to_bf16(usable_kernels().back())) names.emplace_back("bf16");
  for (const KernelSet& set : test::lowered_kernels()) names.emplace_back(set.name);
  int n_streamed = 0;
  unsigned seed = 0;
  for (const DType type : {DType::f32, DType::bf16}) {
    const Matrices matrices(type);
    for (const std::string& kernels : names)
      for (unsigned i = 0; i < test::some_random(kGraphs); ++i, seed += 4) {
        CAPTURE(kernels);
        CAPTURE(seed);
        n_streamed += check_budgets(matrices, kernels, seed);
      }
  }
  CHECK(n_streamed > static_cast<int>(seed) / 4);  // of two budgets of each graph more than one
}

}  // namespace stream_order_test
