// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "bundle/content.h"
#include "bundle/encoding.h"
#include "lower/host/memory.h"

namespace vla::lower {

/// Elements of a matrix from the bundle's encoding to that in memory. What encodings there are between the two is known
/// here alone.
struct Recode {
  Encoding stored, wanted;

  bool changes() const { return wanted.type != stored.type; }
  /// Bytes that `operator()` takes of its buffer.
  std::size_t buffer_size(std::int64_t count) const {
    const std::int64_t row = Int4Block::n_of(wanted.group) * Int4Block::kElements;
    return aligned(wanted.size(count)) + static_cast<std::size_t>(row) * sizeof(float);
  }
  /// `count` elements, whole groups of them, as they are wanted: in `buffer`, or `from` itself where nothing changes.
  /// from_scales: those of codes that become floats; scales: room for those that codes get.
  const std::byte* operator()(const std::byte* from, const float* from_scales, std::int64_t count, ReadBuffer& buffer,
                              float* scales) const;
};

}  // namespace vla::lower
