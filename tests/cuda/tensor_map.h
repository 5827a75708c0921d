// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <span>
#include <vector>

#include "cuda/fault.h"
#include "cuda/kernels/tensor_map.h"

namespace vla::test::cuda {

/// What the driver of tests writes to a TensorMap: 16-bit numbers in up to four dimensions, the first without a stride,
/// whose boxes are rows that are swizzled over their 128 or 32 bytes. Places are in the order of dimensions.
struct TensorMapFields {
  static constexpr std::uint32_t kMark = 0x70616d2d;
  std::uint32_t mark = kMark, n_dimension = 0;
  std::uint64_t address = 0, size[4] = {1, 1, 1, 1}, stride[4] = {};  // stride[i]: bytes, of dimension i
  std::uint16_t box[4] = {1, 1, 1, 1};

  /// The address of a place, or 0 outside.
  std::uint64_t at(const std::int64_t (&place)[4]) const {
    std::uint64_t sum = address;
    for (int i = 0; i < 4; ++i) {
      if (place[i] < 0 || place[i] >= static_cast<std::int64_t>(size[i])) return 0;
      sum += static_cast<std::uint64_t>(place[i]) * stride[i];
    }
    return sum;
  }
};
static_assert(sizeof(TensorMapFields) <= sizeof(vla::cuda::TensorMap));

/// Copies a box from a place on to where it lies in shared memory from an address on. read(address, size) is asked for
/// bytes of global memory, at most 16 at a time; what is outside of the sizes is zeros.
template <class Read>
std::vector<std::byte> copy_box(const void* map, std::span<const int> first, std::size_t to, Read read) {
  constexpr std::size_t kChunk = 16, kElement = 2;
  TensorMapFields of;
  std::memcpy(&of, map, sizeof(of));
  if (of.mark != TensorMapFields::kMark) throw Fault("no tensor map that a driver has made");
  if (of.n_dimension != first.size()) throw Fault("a box of another number of dimensions than its map");
  const std::size_t row = of.box[0] * kElement;
  if (row != 128 && row != 32) throw Fault("a box whose rows are not of 128 or 32 bytes");
  std::vector<std::byte> box(row * of.box[1] * of.box[2] * of.box[3]);
  for (std::size_t i = 0; i < box.size(); i += kElement) {
    std::int64_t place[4] = {};
    for (std::size_t d = 0, rest = i / kElement; d < first.size(); rest /= of.box[d], ++d)
      place[d] = first[d] + static_cast<std::int64_t>(rest % of.box[d]);
    const std::uint64_t from = of.at(place);
    if (from == 0) continue;
    const std::size_t plain = to + i, swizzled = plain ^ (plain >> 7 & (row / kChunk - 1)) * kChunk;
    // Sixteen bytes where they are one piece of a row.
    const bool whole = from % kChunk == 0 && i % kChunk == 0 && place[0] + 7 < static_cast<std::int64_t>(of.size[0]);
    const std::size_t n = whole ? kChunk : kElement;
    std::memcpy(&box[swizzled - to], read(static_cast<std::uintptr_t>(from), n), n);
    if (whole) i += kChunk - kElement;
  }
  return box;
}

}  // namespace vla::test::cuda
