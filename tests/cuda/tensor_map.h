// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

#include "cuda/fault.h"
#include "cuda/kernels/tensor_map.h"

namespace vla::test::cuda {

/// What the driver of tests writes to a TensorMap: rows of 16-bit numbers, whose boxes are swizzled over 128 bytes.
struct TensorMapFields {
  static constexpr std::uint64_t kMark = 0x70616d2d736f7764;
  std::uint64_t mark = kMark, address = 0, n_column = 0, n_row = 0, stride = 0;  // stride in bytes
  std::uint32_t box_columns = 0, box_rows = 0;
};

/// Copies a box from (column, row) on to where it lies in shared memory from an address on. read(address, size) is
/// asked for bytes of global memory, at most 16 at a time; what is outside of the rows is zeros.
template <class Read>
std::vector<std::byte> copy_box(const void* map, int column, int row, std::size_t to, Read read) {
  constexpr std::size_t kRow = 128, kChunk = 16, kElement = 2;
  TensorMapFields of;
  std::memcpy(&of, map, sizeof(of));
  if (of.mark != TensorMapFields::kMark) throw Fault("no tensor map that a driver has made");
  const std::size_t size = of.box_columns * kElement;
  if (size != kRow) throw Fault("a box whose rows are not of 128 bytes");
  std::vector<std::byte> box(of.box_rows * kRow);
  for (std::size_t i = 0; i < box.size(); i += kElement) {
    const std::int64_t x = column + static_cast<std::int64_t>(i % kRow / kElement);
    const std::int64_t y = row + static_cast<std::int64_t>(i / kRow);
    const auto is_inside = [](std::int64_t at, std::uint64_t n) {
      return at >= 0 && at < static_cast<std::int64_t>(n);
    };
    if (!is_inside(x, of.n_column) || !is_inside(y, of.n_row)) continue;
    const std::size_t plain = to + i, swizzled = plain ^ (plain >> 7 & 7) * kChunk;
    const std::uint64_t from = of.address + static_cast<std::uint64_t>(y) * of.stride;
    const auto at = static_cast<std::uintptr_t>(from + static_cast<std::uint64_t>(x) * kElement);
    // Sixteen bytes where they are one piece of a row.
    const bool whole = at % kChunk == 0 && i % kChunk == 0 && is_inside(x + 7, of.n_column);
    const std::size_t n = whole ? kChunk : kElement;
    std::memcpy(&box[swizzled - to], read(at, n), n);
    if (whole) i += kChunk - kElement;
  }
  return box;
}

}  // namespace vla::test::cuda
