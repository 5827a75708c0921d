// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "bundle/params.h"
#include "kernels/linear_kernel.h"
#include "lower/host/recode.h"

namespace vla::lower {

/// A kernel's matrix format: the bytes of a matrix, and a function that packs rows. Rows that start at a multiple of 64
/// can be packed independently of the rows before.
struct Packing {
  std::size_t (*size)(const kernels::MatrixDesc& desc) = nullptr;
  void (*pack)(const kernels::MatrixDesc& desc, const std::byte* stored, std::byte* packed) = nullptr;
};

/// A matrix's layout and address in memory.
struct MatrixPlace {
  Encoding encoding;
  Packing packing;
  std::int64_t n_scale = 0;  // scales stored after the matrix: the bundle's, or computed from floats
  std::byte* data = nullptr;
  float* scales = nullptr;  // null if there are none

  /// Bytes of the packed matrix and its scales, both aligned.
  std::size_t size_of(const Param& param) const;
  /// Offset of the scales in bytes.
  std::size_t scales_begin(const Param& param) const;
  /// Sets the addresses: the packed matrix at `to`, its scales after it.
  void put(const Param& param, std::byte* to);
};

/// A part of a parameter on its way from the bundle's file to memory.
struct PackPart {
  std::span<const std::byte> from;
  std::byte* to = nullptr;
  kernels::MatrixDesc desc = {};
  decltype(Packing::pack) pack = nullptr;  // null: a copy
  Recode recode = {};
  float* scales = nullptr;                      // destination of the scales, one per row
  std::span<const std::byte> from_scales = {};  // the bundle's scales: one per row, or one in all
};

/// Cuts a matrix into parts of about one megabyte.
void add_parts(const Param& matrix, const MatrixPlace& place, std::vector<PackPart>& parts);

/// Buffers of one thread that reads parts. Each thread holds at most one part in memory twice.
class Packer {
 public:
  /// Allocates what these parts need, so that threads never run out of memory. Throws std::bad_alloc.
  void reserve(std::span<const PackPart> parts);
  /// Reads and packs a part. Returns false if the file no longer has these bytes.
  bool run(const Content& content, const PackPart& part);

 private:
  ReadBuffer read_, scales_, recoded_;
};

}  // namespace vla::lower
