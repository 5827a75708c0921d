// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

#include "backend/isa.h"
#include "bundle/bundle.h"

namespace vla {

/// A weight matrix as the bundle has it: d_out rows of d_in numbers, one row after the other.
struct MatrixDesc {
  DType type;
  std::int64_t d_in, d_out;
};

/// How a matrix lies in memory, which is what the kernel that multiplies by it wants.
struct MatrixFormat {
  const char* name;  // of the kernel
  /// Bytes of the packed matrix.
  std::size_t (*packed_size)(const MatrixDesc& desc);
  /// `stored` and `packed` start at multiples of 32 and 64 bytes.
  void (*pack)(const MatrixDesc& desc, const std::byte* stored, std::byte* packed);
};

/// Chooses by storage type, shape and machine. Null: the matrix is widened to float32 for ggml's product.
using ChooseFormat = const MatrixFormat* (*)(const MatrixDesc& desc, Isa isa);

}  // namespace vla
