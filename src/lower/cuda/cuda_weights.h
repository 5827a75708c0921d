// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "cuda/kernels/linear_int8.h"
#include "graph/rounding.h"
#include "lower/cuda/cuda_queue.h"
#include "lower/host/device_windows.h"

namespace vla::lower {

/// The kernels that multiply by a matrix. bf16 kernels read rows of bf16; ternary, int4 and int8 kernels read rows of
/// int8 codes.
enum class MatrixKind { f32, bf16, ternary, int4, int8 };
constexpr bool is_of_codes(MatrixKind kind) { return kind >= MatrixKind::ternary; }
/// The code kind of a matrix of codes.
constexpr cuda::CodeKind code_kind(MatrixKind kind) {
  return static_cast<cuda::CodeKind>(static_cast<int>(kind) - static_cast<int>(MatrixKind::ternary));
}
static_assert(code_kind(MatrixKind::int8) == cuda::CodeKind::int8);

/// The prefix of the kernels' names, such as `linear_bf16`.
std::string kernel_name(MatrixKind kind);

/// A parameter's address and layout on the device: vectors and float32 matrices as float32, tables as stored, other
/// matrices as their kernels read them.
struct CudaWeight {
  MatrixKind kind = MatrixKind::f32;
  Encoding encoding;
  cuda::Address data = 0, scales = 0;  // scales [d_out] of matrices of codes
};

/// bf16 rows are padded to a multiple of 8 elements.
constexpr std::int64_t bf16_stride(std::int64_t n) { return cuda::round_up(n, 8); }

class CudaWeights {
 public:
  /// Loads the parameters. Matrices stored as bf16 are multiplied as bf16. rounding: bf16, int8 or int4 converts large
  /// float matrices to that type; float32 converts all but ternary matrices to float32. fill: whether to read the file.
  /// plan: the matrices that are streamed from the file in every act. Errors: out_of_memory, bad_bundle, device,
  /// unsupported if no matrix would get the requested type.
  static Result<CudaWeights> load(const ParamList& list, Rounding rounding, bool fill, const WeightPlan& plan,
                                  const std::shared_ptr<CudaQueue>& queue);

  const CudaWeight& operator[](const Param& param) const { return all_[static_cast<std::size_t>(param.id)]; }
  /// Bytes of all resident parameters, and of the windows for streamed ones.
  const std::shared_ptr<cuda::Buffer>& memory() const { return memory_; }
  /// Bytes of a matrix.
  std::size_t size_of(const Param& matrix) const;
  /// The streamed group of each parameter, by Param::id; -1 if it is resident.
  const std::vector<int>& groups() const { return groups_; }
  /// The windows of streamed groups; null if there are none or the weights were not read.
  const std::shared_ptr<DeviceWindows>& windows() const { return windows_; }
  bool has(MatrixKind kind) const;
  bool has_codes() const;
  /// The kernels, and how many matrices each multiplies: `linear_bf16 (98 bf16), linear_f32 (3 f32)`
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
