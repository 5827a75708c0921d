// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>

#include "support/graph_runner.h"
#include "support/param_set.h"

namespace vla::test {

/// A chain of layers as the prefix, and a product as the step, whose matrix is the prefix's last as well.
class Chain {
 public:
  static constexpr int kLayers = 9;

  Chain(DType type, int depth) : type_(type), depth_(depth), set_(pieces()) {
    for (int i = 0; i < kLayers; ++i) {
      const Scope scope = set_.scope() / "layer" / i;
      matrices_.push_back(type == DType::ternary ? scope.ternary("weight", depth, depth)
                                                 : scope.matrix("weight", depth, depth));
    }
  }
  const ParamList& list() const { return set_.list(); }
  std::int64_t depth() const { return depth_; }

  /// x through the layers from `first` to `last`.
  std::unique_ptr<Program> lower(Device& device, Slots& slots, const Slot* x, Slot* y, int first, int last) const {
    Graph g(slots);
    Tensor at = g.input(x);
    const op::Rule rule = type_ == DType::ternary ? op::Rule::int8_rows : op::Rule::floats;
    for (int i = first; i <= last; ++i)
      at = g.add(op::Activate{Activation::gelu_tanh},
                 {g.add(op::Linear{matrices_[static_cast<std::size_t>(i)], nullptr, rule}, {at})});
    g.write(at, y);
    auto program = device.lower(g, {});
    REQUIRE_MESSAGE(program.ok(), (program ? "" : program.error().message()));
    return std::move(*program);
  }

 private:
  std::vector<ParamSet::Piece> pieces() const {
    const std::size_t count = static_cast<std::size_t>(depth_) * static_cast<std::size_t>(depth_);
    std::vector<ParamSet::Piece> all;
    for (int i = 0; i < kLayers; ++i) {
      const std::string name = "layer." + std::to_string(i) + ".";
      std::vector<float> values = ramp(count, 0.1f + 0.02f * static_cast<float>(i));
      if (type_ == DType::ternary) {
        for (float& value : values) value = value > 0.04f ? 1.0f : value < -0.04f ? -1.0f : 0.0f;
        all.push_back({name + "scale", {1}, {0.05f + 0.01f * static_cast<float>(i)}});
      }
      all.push_back({name + "weight", {depth_, depth_}, std::move(values), type_});
    }
    return all;
  }

  DType type_;
  int depth_;
  ParamSet set_;
  std::vector<const Param*> matrices_;
};

/// What programs on a device answer, with all matrices in memory or as few as it can.
class ChainAnswers {
 public:
  ChainAnswers(const Chain& chain, std::unique_ptr<Device> device, bool streams)
      : chain_(chain), device_(std::move(device)) {
    WeightPlan plan;
    std::size_t resident = 0;
    if (streams) {
      REQUIRE(device_->load(chain.list(), false).ok());
      make_programs();
      plan = *device_->plan_weights(*prefix_, *step_, 0);
      resident = device_->weights_size();
      CHECK(plan.streamed.size() == Chain::kLayers - 1);
      CHECK(plan.n_read > 0);
      drop_programs();
    }
    REQUIRE(device_->load(chain.list(), true, plan).ok());
    make_programs();
    if (streams) {
      CHECK(device_->weights_size() < resident);
      CHECK(device_->weights_size() == plan.smallest);
    }
  }

  std::vector<float> run(int seed) {
    std::vector<float> rows = ramp(static_cast<std::size_t>(chain_.depth()) * 5, 1.0f + static_cast<float>(seed));
    device_->set(*x_, rows.data(), x_->size());
    REQUIRE(prefix_->run().ok());
    for (int k = 0; k < 3; ++k) REQUIRE(step_->run().ok());
    std::vector<float> all = device_->get(*z_);
    REQUIRE(backward_->run().ok());  // another order than the plan's
    for (const float value : device_->get(*z_)) all.push_back(value);
    REQUIRE(device_->failure().ok());
    return all;
  }

 private:
  void make_programs() {
    slots_ = Slots();
    for (Slot** slot : {&x_, &y_, &z_}) *slot = slots_.add_f32({chain_.depth(), 5, 1, 1});
    REQUIRE(device_->allocate(slots_).ok());
    prefix_ = chain_.lower(*device_, slots_, x_, y_, 0, Chain::kLayers - 1);
    step_ = chain_.lower(*device_, slots_, y_, z_, Chain::kLayers - 1, Chain::kLayers - 1);
    backward_ = chain_.lower(*device_, slots_, x_, z_, 2, 4);
  }
  void drop_programs() {
    for (auto* program : {&prefix_, &step_, &backward_}) program->reset();
    slots_ = Slots();
  }

  const Chain& chain_;
  std::unique_ptr<Device> device_;
  Slots slots_;
  Slot *x_ = nullptr, *y_ = nullptr, *z_ = nullptr;
  std::unique_ptr<Program> prefix_, step_, backward_;
};

}  // namespace vla::test
