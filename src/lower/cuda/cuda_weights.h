// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "graph/rounding.h"
#include "lower/cuda/cuda_windows.h"

namespace vla::lower {

/// Which kernels multiply by a matrix. bf16 ones read bf16 rows, ternary and int8 ones rows of int8 codes.
enum class MatrixKind { f32, bf16, ternary, int8 };

/// A parameter's place and layout on the device: vectors and f32 matrices as float32, tables as they are stored, other
/// matrices as their kernels want them.
struct CudaWeight {
  MatrixKind kind = MatrixKind::f32;
  Encoding encoding;
  cuda::Address data = 0, scales = 0;  // scales [d_out], of ternary and int8 matrices
};

/// bf16 rows begin at a multiple of 8 elements.
constexpr std::int64_t bf16_stride(std::int64_t n) { return cuda::round_up(n, 8); }

class CudaWeights {
 public:
  /// Matrices that are stored as bf16 are multiplied so, and with bf16 or
  /// int8 large ones of floats become that; with float32 all but ternary ones are float32. fill: whether to read them.
  /// plan: which matrices come from the file in every act instead. Errors: out_of_memory, bad_bundle, device.
  static Result<CudaWeights> load(const ParamList& list, Rounding rounding, bool fill, const WeightPlan& plan,
                                  const std::shared_ptr<CudaQueue>& queue);

  const CudaWeight& operator[](const Param& param) const { return all_[static_cast<std::size_t>(param.id)]; }
  /// Of all parameters, and the windows of those that are streamed.
  const std::shared_ptr<cuda::Buffer>& memory() const { return memory_; }
  /// Bytes of a matrix.
  std::size_t size_of(const Param& matrix) const;
  /// By Param::id, its group among those of the plan that are streamed, or -1.
  const std::vector<int>& groups() const { return groups_; }
  /// Where those come to; null where there are none, or nothing is filled.
  const std::shared_ptr<DeviceWindows>& windows() const { return windows_; }
  bool has(MatrixKind kind) const;
  /// `linear_bf16 (98 bf16), linear_f32 (3 f32)`
  const std::string& text() const { return text_; }

 private:
  CudaWeight& at(const Param& param) { return all_[static_cast<std::size_t>(param.id)]; }
  bool is_streamed(const Param& param) const { return groups_[static_cast<std::size_t>(param.id)] >= 0; }
  void choose(const ParamList& list, Rounding rounding);
  Status give_places(const ParamList& list, const WeightPlan& plan, CudaQueue& queue);
  Status fill(const ParamList& list, CudaQueue& queue) const;
  Status start_stream(const ParamList& list, const WeightPlan& plan, const std::shared_ptr<CudaQueue>& queue);

  std::vector<CudaWeight> all_;  // by Param::id
  std::vector<int> groups_;
  std::shared_ptr<cuda::Buffer> memory_;
  std::shared_ptr<DeviceWindows> windows_;
  std::string text_;
};

}  // namespace vla::lower
