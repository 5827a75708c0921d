// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/device.h"
#include "lower/cuda/cuda_queue.h"
#include "lower/cuda/cuda_ways.h"
#include "lower/cuda/cuda_weights.h"
#include "lower/cuda/gpu_model.h"

namespace vla::lower {

/// A GPU that runs our own kernels (cuda/kernels). An act is one captured graph.
class CudaDevice final : public Device {
 public:
  /// modules: the kernels' PTX. at_load: see CudaWeights::load. The environment may name other ways
  /// to lower graphs (cuda_ways.h). Errors: device, usage.
  static Result<std::unique_ptr<Device>> open(const cuda::Driver& driver, int index,
                                              const std::vector<std::string>& modules, Rounding at_load);
  /// Models a GPU that is not present (DeviceLibrary::model). Errors: usage for an unknown name.
  static Result<std::unique_ptr<Device>> model(const std::string& name, Rounding at_load);

  Status load(const ParamList& params, bool fill, const WeightPlan& plan) override;
  Result<WeightPlan> plan_weights(const Program& prefix, const Program& step, std::size_t size) const override;
  Status allocate(Slots& slots) override;
  void set(const Slot& slot, const void* data, std::size_t size) override;
  void get(const Slot& slot, void* data, std::size_t size) const override;
  std::shared_ptr<float[]> host_memory(std::size_t n) override;
  std::unique_ptr<Sent> send(const void* data, std::size_t size) override { return queue_->send(data, size); }
  void take(const Slot& slot, const Sent& sent) override;
  Status failure() const override { return queue_->failure(); }
  Result<std::unique_ptr<Program>> lower(const Graph& graph, const LowerOptions& options) override;

  std::string name() const override { return name_; }
  int n_thread() const override { return 1; }
  bool is_host() const override { return false; }
  std::string kernels() const override;
  Precision precision() const override;
  Rounding rounding() const override { return rounding_; }
  bool has_bf16() const override { return true; }
  const std::string& linear_kernels() const override { return weights_.text(); }
  std::size_t weights_size() const override { return weights_.memory() ? weights_.memory()->size() : 0; }
  std::size_t working_size() const override { return arena_ ? arena_->size() : 0; }

 private:
  CudaDevice(const std::string& name, std::shared_ptr<CudaQueue> queue, const CudaWays& ways, Rounding at_load)
      : name_(name + text_of(ways)), queue_(std::move(queue)), ways_(ways), rounding_(at_load) {}

  std::string name_;
  std::optional<GpuModel> model_;
  std::shared_ptr<CudaQueue> queue_;  // destroyed after all device memory
  CudaWeights weights_;
  std::shared_ptr<cuda::Buffer> arena_;
  CudaWays ways_;
  Rounding rounding_;
  std::int64_t min_rounded_keys_ = 0;
};

}  // namespace vla::lower
