// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/driver/gpu.h"
#include "graph/device.h"
#include "lower/cuda/cuda_weights.h"

namespace vla::lower {

/// A GPU that our own kernels run on (cuda/kernels). Each program is one captured graph.
class CudaDevice final : public Device {
 public:
  /// modules: the kernels as PTX. at_load: as CudaWeights::load takes it. Errors: device, unsupported for int4.
  static Result<std::unique_ptr<Device>> open(const cuda::Driver& driver, int index,
                                              const std::vector<std::string>& modules, Rounding at_load);

  Status load(const ParamList& params, bool fill) override;
  Status allocate(Slots& slots) override;
  void set(const Slot& slot, const void* data, std::size_t size) override;
  void get(const Slot& slot, void* data, std::size_t size) const override;
  Status failure() const override { return shared_->failure; }
  Result<std::unique_ptr<Program>> lower(const Graph& graph, const LowerOptions& options) override;

  std::string name() const override { return "cuda, own kernels"; }
  int n_thread() const override { return 1; }
  bool is_host() const override { return false; }
  std::string kernels() const override;
  Precision precision() const override;
  Rounding rounding() const override { return rounding_; }
  bool has_bf16() const override { return true; }
  const std::string& linear_kernels() const override { return weights_.text(); }
  std::size_t weights_size() const override { return weights_.memory() ? weights_.memory()->size() : 0; }
  std::size_t working_size() const override { return arena_ ? arena_->size() : 0; }

  /// What programs and the device share: the stream, and the first failure.
  struct Shared {
    std::unique_ptr<cuda::Gpu> gpu;
    std::unique_ptr<cuda::Stream> stream;
    Status failure;

    /// Keeps the first failure.
    Status keep(Status status);
  };

 private:
  explicit CudaDevice(Rounding at_load) : rounding_(at_load) {}

  std::shared_ptr<Shared> shared_;  // goes after all memory
  CudaWeights weights_;
  std::shared_ptr<cuda::Buffer> arena_;
  Rounding rounding_;
  std::int64_t min_rounded_keys_ = 0;
};

}  // namespace vla::lower
