// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "bundle/params.h"
#include "kernels/linear_kernel.h"
#include "lower/cpu/recode.h"

namespace vla::lower {

/// A matrix as it lies in memory, and where.
struct MatrixPlace {
  Encoding encoding;
  const kernels::LinearKernel* kernel = nullptr;
  std::byte* data = nullptr;
  float* scales = nullptr;  // that are made of floats, as they are rounded to codes; null where there are none

  /// Bytes of the packed matrix `param` with the scales that are made, each aligned.
  std::size_t size_of(const Param& param) const;
  /// The packed matrix goes to `to`, and scales that are made behind it.
  void put(const Param& param, std::byte* to);
};

/// Some of a parameter on its way from the bundle's file to its place in memory.
struct PackPart {
  std::span<const std::byte> from;
  std::byte* to = nullptr;
  kernels::MatrixDesc desc = {};
  const kernels::LinearKernel* kernel = nullptr;  // null: a copy
  Recode recode = {};
  float* scales = nullptr;                      // where they are made
  std::span<const std::byte> from_scales = {};  // of codes that become floats
};

/// Cuts a matrix into parts of about a megabyte.
void add_parts(const Param& matrix, const MatrixPlace& place, std::vector<PackPart>& parts);

/// One thread's buffers for reading parts, so that no more than a part for each thread stands in memory twice.
class Packer {
 public:
  /// Takes the memory that these parts need, since threads must not run out of it. Throws std::bad_alloc.
  void reserve(std::span<const PackPart> parts);
  /// False where the file has not these bytes any more.
  bool run(const Content& content, const PackPart& part);

 private:
  Room read_, scales_, recoded_;
};

}  // namespace vla::lower
