// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

namespace vla::cuda {

/// CUtensorMap: rows in global memory of which Hopper copies boxes to shared memory. Only the driver knows what is in
/// it (Gpu::map_rows). A kernel's job holds it, so that it lies in the kernel's parameters.
struct alignas(64) TensorMap {
  std::uint64_t opaque[16];
};

/// Heads of bf16 in device memory: d_head elements of each head, token and batch, with strides in elements: multiples
/// of 8, each of the one before.
struct MappedHeads {
  const void* data;
  int d_head, n_head, n_token, n_batch;
  std::int64_t head, token, batch;
  int box_columns, box_tokens;  // box_columns: 64 or 16, as many as a swizzled row has
};

/// Rows of bf16 in device memory, `stride` elements apart: a multiple of 8, as the address is of 16 bytes.
struct MappedRows {
  const std::uint16_t* rows;
  int n_row, depth;
  std::int64_t stride;
  int box_rows;  // at most 256
};

}  // namespace vla::cuda
