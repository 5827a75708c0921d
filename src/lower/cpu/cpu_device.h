// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/device.h"
#include "kernels/executor.h"
#include "kernels/kind_clock.h"
#include "lower/arithmetic.h"
#include "lower/cpu/cpu_weights.h"

namespace vla::lower {

/// Runs graphs on this machine's cores with our own kernels.
class CpuDevice final : public Device {
 public:
  /// Errors: device.
  static Result<std::unique_ptr<Device>> open(int n_thread, const Arithmetic& arithmetic);

  Status load(const ParamList& params, bool fill, const WeightPlan& plan = {}) override;
  Result<WeightPlan> plan_weights(const Program& prefix, const Program& step, std::size_t size) const override;
  Status allocate(Slots& slots) override;
  void set(const Slot& slot, const void* data, std::size_t size) override;
  void get(const Slot& slot, void* data, std::size_t size) const override;
  Result<std::unique_ptr<Program>> lower(const Graph& graph, const LowerOptions& options) override;

  std::string name() const override;
  int n_thread() const override { return executor_->n_thread(); }
  std::string kernels() const override { return name_of(arithmetic_.use); }
  Features features() const override { return arithmetic_.use; }
  Precision precision() const override {
    if (weights_.has_int8()) return Precision::int8;
    return rounds_to_bf16(arithmetic_.use) ? Precision::bf16 : Precision::f32;
  }
  Rounding rounding() const override { return arithmetic_.at_load; }
  bool has_bf16() const override { return rounds_to_bf16(this_cpu()); }
  const std::string& linear_kernels() const override { return weights_.text(); }
  const CpuWeights& weights() const { return weights_; }
  std::size_t weights_size() const override { return weights_.size(); }
  std::size_t working_size() const override { return arena_.size() + executor_->scratch_size(); }
  void count_times(bool on) override;
  std::vector<std::pair<std::string, double>> times() const override;
  void touch() override;

 private:
  explicit CpuDevice(const Arithmetic& arithmetic) : arithmetic_(arithmetic) {}

  Arithmetic arithmetic_;
  std::int64_t min_rounded_keys_ = 0;
  std::shared_ptr<kernels::Executor> executor_;
  std::shared_ptr<kernels::KindClock> clock_ = std::make_shared<kernels::KindClock>();
  CpuWeights weights_;
  Memory arena_;  // memory for the values of one run; all programs share it, since one runs at a time
};

}  // namespace vla::lower
