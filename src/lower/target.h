// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

#include "bundle/params.h"

namespace vla::lower {

/// The abilities of a machine. Passes that hold for every machine ask for them;
/// parameters must be loaded.
class Target {
 public:
  virtual ~Target() = default;

  /// The kernel that multiplies by a matrix, told apart by its address: products
  /// of one x may be one operation, and so may gate and up, where it is the same.
  virtual const void* multiplier(const Param& matrix) const = 0;
  /// How many products of one x may be one operation.
  virtual std::size_t max_products() const = 0;
  /// The widest row whose norm a product computes as it reads x; 0: it computes
  /// none.
  virtual std::int64_t max_norm(const Param& matrix) const = 0;
  /// Whether a product takes x as images under a window.
  virtual bool takes_windows(const Param& matrix) const = 0;
  /// Whether a ReLU behind its residual is part of a product.
  virtual bool takes_relu(const Param& matrix) const = 0;
  /// How a matrix lies in memory.
  virtual const Encoding& encoding(const Param& matrix) const = 0;
  /// Attention over fewer keys is float32.
  virtual std::int64_t min_rounded_keys() const = 0;
  /// Whether taps are read when a run has ended; else behind the phase that makes their value.
  virtual bool keeps_taps() const { return true; }
  /// Every value starts at a multiple of so many bytes.
  virtual std::size_t alignment() const = 0;
};

}  // namespace vla::lower
