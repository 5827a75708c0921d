// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/linear_bf16.h"
#include "cuda/kernels/tensor_map.h"

/// Products of many rows and a bf16 matrix on Hopper, whose operands one thread of a block fetches by the tensor memory
/// accelerator (TMA) while two warpgroups multiply. Blocks of a cluster have the same rows and adjacent columns: each
/// fetches a part of the rows for all.
namespace vla::cuda {

struct HopperTmaJob {
  TensorMap x, weight, gate_weight;  // of the product's operands, see mapped_x and mapped_weight
  LinearBf16Job product;             // undivided, without rotation and beginning of a norm
};

#define VLA_HOPPER_TMA_TILES(each) each(128, 192) each(128, 256)
struct HopperTmaTile {
  const char* kernel;
  int columns, rows;  // of gated products half of the columns belong to each matrix
  bool is_gated;
  /// Columns of y of a block.
  int columns_y() const { return is_gated ? columns / 2 : columns; }
};
constexpr HopperTmaTile kHopperTmaTiles[] = {
#define VLA_HOPPER_TMA_TILE(columns, rows) {"hopper_tma_bf16_" #columns "x" #rows, columns, rows, false},
    VLA_HOPPER_TMA_TILES(VLA_HOPPER_TMA_TILE)
#undef VLA_HOPPER_TMA_TILE
#define VLA_HOPPER_TMA_TILE(columns, rows) {"hopper_tma_bf16_" #columns "x" #rows "_gated", columns, rows, true},
        VLA_HOPPER_TMA_TILES(VLA_HOPPER_TMA_TILE)
#undef VLA_HOPPER_TMA_TILE
};

/// The tile of the same shape whose operands TMA fetches, or null.
inline const HopperTmaTile* tma_tile_of(const HopperTile& tile) {
  for (const HopperTmaTile& one : kHopperTmaTiles)
    if (one.columns == tile.columns && one.rows == tile.rows && one.is_gated == tile.is_gated) return &one;
  return nullptr;
}

constexpr int kTmaCluster = 2;  // blocks
/// Bytes of a stage's two mbarriers, and the number of stages that shared memory holds with them.
constexpr int kTmaBarriers = 16;
constexpr int hopper_tma_stages(int columns, int rows) {
  return static_cast<int>(kHopperShared) / (hopper_stage_bytes(columns, rows) + kTmaBarriers);
}

inline MappedRows mapped_x(const HopperTmaTile& tile, const LinearBf16Job& job) {
  return {static_cast<const std::uint16_t*>(job.x), job.n_row, job.depth, job.x_stride, tile.rows / kTmaCluster};
}
/// weight: the product's matrix, or the gate's.
inline MappedRows mapped_weight(const HopperTmaTile& tile, const LinearBf16Job& job, const std::uint16_t* weight) {
  return {weight, job.n_column, job.depth, job.weight_stride, tile.columns_y()};
}

inline Launch hopper_tma_bf16(const HopperTmaTile& tile, const LinearBf16Job& job) {
  const int stage = hopper_stage_bytes(tile.columns, tile.rows) + kTmaBarriers;
  return {tile.kernel,
          {blocks(job.n_row, tile.rows), blocks(job.n_column, tile.columns_y() * kTmaCluster), kTmaCluster},
          static_cast<unsigned>(tile.columns) * 2 + 32,
          static_cast<unsigned>(hopper_tma_stages(tile.columns, tile.rows) * stage),
          kTmaCluster};
}

}  // namespace vla::cuda
