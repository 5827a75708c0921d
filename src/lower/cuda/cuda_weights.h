// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "graph/rounding.h"
#include "lower/cuda/cuda_queue.h"

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
  /// Errors: out_of_memory, bad_bundle, device.
  static Result<CudaWeights> load(const ParamList& list, Rounding rounding, bool fill, CudaQueue& queue);

  const CudaWeight& operator[](const Param& param) const { return all_[static_cast<std::size_t>(param.id)]; }
  const std::shared_ptr<cuda::Buffer>& memory() const { return memory_; }
  bool has(MatrixKind kind) const;
  /// `linear_bf16 (98 bf16), linear_f32 (3 f32)`
  const std::string& text() const { return text_; }

 private:
  std::vector<CudaWeight> all_;  // by Param::id
  std::shared_ptr<cuda::Buffer> memory_;
  std::string text_;
};

}  // namespace vla::lower
