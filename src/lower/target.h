// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <vector>

#include "bundle/params.h"

namespace vla::lower {

/// The layout that a kernel needs of an operand, from least to most strict. Operands that do not meet it are copied
/// (lower/layout.h).
enum class Needs {
  anything,    // any strides
  unit_rows,   // the elements of a row are contiguous
  even_rows,   // unit rows, all the same distance apart
  contiguous,  // all elements are contiguous
};

/// The abilities of the kernel that multiplies by a matrix.
struct Multiplier {
  /// Identifies the kernel. Products of one x, and gate and up, may be one operation only if their kernel is the same.
  const void* kernel;
  /// The widest row whose norm the kernel computes as it reads x; 0: it computes none.
  std::int64_t max_norm;
  bool takes_windows;        // x may be images; the kernel moves the window over them
  bool takes_relu;           // a ReLU may follow the residual
  const Encoding* encoding;  // the matrix's encoding in memory
};

/// The abilities of a machine that the machine-independent passes ask for. Parameters must be loaded.
struct Target {
  std::function<Multiplier(const Param& matrix)> multiplier;
  Needs norm_needs;               // the need of a norm's x: unit_rows or even_rows
  std::size_t max_products;       // most products of one x in one operation
  std::int64_t min_rounded_keys;  // attention over fewer keys stays float32
  bool keeps_taps;                // true: taps are read after the run; false: after the phase that makes them
  std::size_t alignment;          // bytes; the same for every value
  /// By Param::id, the group in which a matrix is streamed (host/weight_stream.h), or -1.
  const std::vector<int>& groups;

  std::size_t aligned(std::size_t size) const { return (size + alignment - 1) / alignment * alignment; }
};

}  // namespace vla::lower
