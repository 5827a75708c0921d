// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "bundle/content.h"
#include "bundle/encoding.h"
#include "lower/host/memory.h"

namespace vla::lower {

/// Converts elements of a matrix from the bundle's encoding to the one in memory. The only place that knows which
/// conversions exist.
struct Recode {
  Encoding stored, wanted;

  bool changes() const { return wanted.type != stored.type; }
  /// Bytes of `buffer` that `operator()` uses.
  std::size_t buffer_size(std::int64_t count) const {
    const std::int64_t row = Int4Block::n_of(wanted.group) * Int4Block::kElements;
    return aligned(wanted.size(count)) + static_cast<std::size_t>(row) * sizeof(float);
  }
  /// Converts `count` elements (whole groups) into `buffer`, or returns `from` if both encodings are equal.
  /// from_scales: scales of codes that become floats. scales: receives the scales of floats that become codes.
  const std::byte* operator()(const std::byte* from, const float* from_scales, std::int64_t count, ReadBuffer& buffer,
                              float* scales) const;
};

}  // namespace vla::lower
