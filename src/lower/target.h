// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>

#include "bundle/params.h"

namespace vla::lower {

/// How a kernel needs an operand to lie, each more than the one before. What lies otherwise is copied (lower/layout.h).
enum class Needs {
  anything,    // its strides say where elements are
  unit_rows,   // the elements of a row follow each other
  even_rows,   // so they do, and all rows are the same distance apart
  contiguous,  // all elements follow each other
};

/// What a machine's product with a matrix can do.
struct Multiplier {
  /// The kernel, told apart by its address: products of one x may be one operation, and so may gate and up, where it is
  /// the same.
  const void* kernel;
  /// The widest row whose norm it computes as it reads x; 0: it computes none.
  std::int64_t max_norm;
  bool takes_windows;        // x as images under a window
  bool takes_relu;           // behind its residual
  const Encoding* encoding;  // of the matrix in memory
};

/// The abilities of a machine, which passes that hold for every machine ask for. Parameters must be loaded.
struct Target {
  std::function<Multiplier(const Param& matrix)> multiplier;
  Needs norm_needs;               // of a norm's x: unit_rows or even_rows
  std::size_t max_products;       // of one x that may be one operation
  std::int64_t min_rounded_keys;  // attention over fewer keys is float32
  bool keeps_taps;                // taps are read when a run has ended; else behind the phase that makes their value
  std::size_t alignment;          // every value starts at a multiple of so many bytes

  std::size_t aligned(std::size_t size) const { return (size + alignment - 1) / alignment * alignment; }
};

}  // namespace vla::lower
