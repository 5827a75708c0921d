// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/linear_loop.h"

namespace vla::kernels {

/// What tiles of bf16 pairs share. x is rounded to bf16, as PyTorch rounds the activations of a bf16 layer. Products of
/// few rows are bound by reading weights: they have the time to multiply what the rounding leaves, too, so that x
/// counts to 2^-17 there.
struct PairTile {
  using X = std::uint16_t;
  static constexpr int kRows = 32, kColumns = 32;
  // A step of a panel is 24 KiB and stays in the first cache.
  static constexpr int kMaxDepth = 2048, kManyDepth = 1536, kStep = 384, kBlockRows = 256, kSplitRows = 64;
  static constexpr int kXStride = kMaxDepth + 32;
  static constexpr bool kEven = false, kRounds = true;
};

}  // namespace vla::kernels
