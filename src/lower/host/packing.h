// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "bundle/params.h"
#include "kernels/linear_kernel.h"
#include "lower/host/recode.h"

namespace vla::lower {

/// How a kernel wants matrices: bytes of one, and its rows on their way there. Rows from a multiple of 64 on are packed
/// behind those before.
struct Packing {
  std::size_t (*size)(const kernels::MatrixDesc& desc) = nullptr;
  void (*pack)(const kernels::MatrixDesc& desc, const std::byte* stored, std::byte* packed) = nullptr;
};

/// A matrix as it lies in memory, and where.
struct MatrixPlace {
  Encoding encoding;
  Packing packing;
  std::int64_t n_scale = 0;  // that lie behind it: those of the bundle, or that are made of floats
  std::byte* data = nullptr;
  float* scales = nullptr;  // null where none lie behind it

  /// Bytes of the packed matrix `param` with the scales behind it, each aligned.
  std::size_t size_of(const Param& param) const;
  /// Bytes from it to its scales.
  std::size_t scales_begin(const Param& param) const;
  /// The packed matrix goes to `to`, and scales behind it.
  void put(const Param& param, std::byte* to);
};

/// Some of a parameter on its way from the bundle's file to its place in memory.
struct PackPart {
  std::span<const std::byte> from;
  std::byte* to = nullptr;
  kernels::MatrixDesc desc = {};
  decltype(Packing::pack) pack = nullptr;  // null: a copy
  Recode recode = {};
  float* scales = nullptr;                      // where they go, one a row
  std::span<const std::byte> from_scales = {};  // of codes: one a row, or one for all
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
  ReadBuffer read_, scales_, recoded_;
};

}  // namespace vla::lower
