// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>

#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {

/// Launches in an order that their operands allow: one captured graph for a run.
class CudaProgram final : public Program {
 public:
  /// The last pass: addresses and launches. Errors: device, out_of_memory, unsupported.
  static Result<std::unique_ptr<Program>> make(CudaLowering& l, std::shared_ptr<CudaDevice::Shared> shared,
                                               std::vector<std::shared_ptr<cuda::Buffer>> memory);

  Status prepare() override;
  Status run() override;
  const std::vector<Stage>& stages() const override { return stages_; }
  std::vector<Work> work() const override { return work_; }
  const std::vector<Tap>& taps() const override { return taps_; }
  std::vector<float> tap(std::size_t i) const override;
  std::string text() const override { return text_; }
  std::size_t size() const override { return own_->size(); }

 private:
  struct TapPlace {
    cuda::Address data;
    Shape shape, stride;
  };
  Status give_addresses(CudaLowering& l, const cuda::Buffer& arena);
  Status make_calls(const CudaLowering& l);
  void make_taps(const CudaLowering& l);
  Status run_captured();

  std::shared_ptr<CudaDevice::Shared> shared_;
  std::vector<std::shared_ptr<cuda::Buffer>> memory_;  // weights and arena
  std::unique_ptr<cuda::Buffer> own_;                  // what prepare leaves, and constants
  std::vector<Call> prepare_, calls_;
  std::optional<cuda::Owned> graph_;
  std::vector<Stage> stages_;
  std::vector<Work> work_;
  std::vector<Tap> taps_;
  std::vector<TapPlace> tap_places_;
  std::string text_;
};

}  // namespace vla::lower
