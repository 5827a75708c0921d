// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>

#include "lower/cuda/cuda_lowering.h"
#include "lower/cuda/gpu_model.h"

namespace vla::lower {

/// Launches, grouped into phases.
class CudaProgram final : public Program {
 public:
  /// The last pass: assigns addresses and makes launches. Errors: device, out_of_memory, unsupported.
  static Result<std::unique_ptr<Program>> make(CudaLowering& l, std::shared_ptr<CudaQueue> queue,
                                               std::vector<std::shared_ptr<cuda::Buffer>> memory,
                                               const GpuModel* model);
  ~CudaProgram() override;

  Status prepare() override { return run(prepare_); }
  Status run() override { return run(run_); }
  std::optional<Time> ended() const override;
  const std::vector<Stage>& stages() const override { return stages_; }
  std::vector<Work> work() const override { return work_; }
  std::vector<Prediction> predictions() const override { return predictions_; }
  const std::vector<Tap>& taps() const override { return taps_; }
  std::vector<float> tap(std::size_t i) const override;
  std::string text() const override { return text_; }
  std::size_t size() const override { return own_->size(); }
  /// Returns the matrices that each phase reads: the phases of `prepare`, then those of `run`.
  const MatrixReads& reads() const { return reads_; }
  std::size_t n_prepare() const { return n_prepare_; }

 private:
  struct TapPlace {
    cuda::Address data;
    Shape shape, stride;
  };
  /// A part of the run that is launched once its groups of matrices are on the device.
  struct Piece {
    Groups groups;
    CudaPart part;
  };
  static std::vector<Piece> pieces(const std::vector<Segment>& segments, std::vector<std::vector<Calls>>& phases);
  Status run(const std::vector<Piece>& pieces);
  Status give_addresses(CudaLowering& l, const cuda::Buffer& arena);
  /// Makes the launches of prepare and run. Returns the number of kernels per operation.
  Result<std::vector<int>> make_parts(const CudaLowering& l);
  Status make_marks(const CudaLowering& l);
  void make_taps(const CudaLowering& l);

  std::shared_ptr<CudaQueue> queue_;
  std::vector<std::shared_ptr<cuda::Buffer>> memory_;  // weights and arena
  std::shared_ptr<cuda::Buffer> own_;                  // results of prepare, and constants
  std::shared_ptr<DeviceWindows> windows_;             // null if all matrices are resident
  std::vector<Piece> prepare_, run_;                   // one piece each, or several if weights are streamed
  MatrixReads reads_;
  std::size_t n_prepare_ = 0;
  std::vector<Stage> stages_;
  Time ended_;
  std::vector<Work> work_;
  std::vector<Prediction> predictions_;
  std::vector<Tap> taps_;
  std::vector<TapPlace> tap_places_;
  std::string text_;
};

}  // namespace vla::lower
