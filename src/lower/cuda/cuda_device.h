// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/driver/gpu.h"
#include "graph/device.h"

namespace vla::lower {

/// A GPU that our own kernels run on (cuda/kernels), in float32. Each program is one captured graph.
class CudaDevice final : public Device {
 public:
  /// modules: the kernels as PTX. Errors: device.
  static Result<std::unique_ptr<Device>> open(const cuda::Driver& driver, int index,
                                              const std::vector<std::string>& modules);

  /// Errors: also unsupported for ternary matrices, which have products of their own.
  Status load(const ParamList& params, bool fill) override;
  Status allocate(Slots& slots) override;
  void set(const Slot& slot, const void* data, std::size_t size) override;
  void get(const Slot& slot, void* data, std::size_t size) const override;
  Status failure() const override { return shared_->failure; }
  Result<std::unique_ptr<Program>> lower(const Graph& graph, const LowerOptions& options) override;

  std::string name() const override { return "cuda, own kernels"; }
  int n_thread() const override { return 1; }
  bool is_host() const override { return false; }
  std::string kernels() const override { return "float32"; }
  Precision precision() const override { return Precision::f32; }
  Rounding rounding() const override { return Rounding::none; }
  bool has_bf16() const override { return false; }
  const std::string& linear_kernels() const override { return text_; }
  std::size_t weights_size() const override { return weights_ ? weights_->size() : 0; }
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
  CudaDevice() = default;

  std::shared_ptr<Shared> shared_;  // goes after all memory
  std::shared_ptr<cuda::Buffer> weights_, arena_;
  std::vector<cuda::Address> places_;  // of parameters, by Param::id; 0 for those that are not there
  std::string text_;
};

}  // namespace vla::lower
