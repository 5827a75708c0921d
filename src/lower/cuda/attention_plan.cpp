// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <numeric>

#include "lower/cuda/cluster_cost.h"
#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {
namespace {

/// Cost model of attention, in microseconds and rates per microsecond, fitted to 218 measurements on an H200 (every
/// shape and number of shares for 13 sizes of four policies; 85 % of the estimates are within 25 % of the measurement).
struct AttentionRates {
  double tile;      // time of a tile of keys, without its products
  double products;  // rate of a block: query rows x keys x elements of a head
  double further;   // the fraction of a block's time that each further block on an SM adds
};
constexpr AttentionRates kOneGroup = {.tile = 0.43, .products = 300e3, .further = 0.38},
                         kSharedKeys = {.tile = 1.5, .products = 750e3, .further = 0.83};
/// kStart: time to start a block, with its first loads. kCombine: time of the kernel that combines shares of the keys.
constexpr double kStart = 2.9, kCombine = 2.7;
/// Bytes of partial sums that one SM moves per microsecond.
constexpr double kPartial = 12.4e3;

/// What attention computes, as plan_attention is told it.
struct AttentionSize {
  std::int64_t d_head, n_row, n_unit, n_key;
};

/// The estimated time of a plan's shape and shares.
double microseconds(const AttentionPlan& plan, const AttentionSize& size, int n_sm) {
  const auto& [d_head, n_row, n_unit, n_key] = size;
  const cuda::AttentionShape& shape = *plan.shape;
  const AttentionRates& rates = shape.key_groups > 1 ? kSharedKeys : kOneGroup;
  const std::int64_t n_block = ceil_div(n_row, shape.rows) * n_unit * plan.n_split;
  const std::int64_t share = ceil_div(n_key, plan.n_split), n_tile = ceil_div(share, shape.keys);
  const double products = static_cast<double>(shape.rows) * shape.keys * shape.depth;
  double block = static_cast<double>(n_tile) * (rates.tile + products / rates.products);
  if (plan.in_cluster)
    block += combine_us(static_cast<double>((d_head + 2) * std::min<std::int64_t>(shape.rows, n_row)), plan.n_split);
  const int n_usable = plan.in_cluster ? usable_sms(n_sm, plan.n_split) : n_sm;
  const double each = 1 + rates.further * static_cast<double>(ceil_div(n_block, n_usable) - 1);
  const double us = kStart + each * block;
  if (plan.n_split == 1 || plan.in_cluster) return us;
  return us + kCombine + 8.0 * static_cast<double>((d_head + 2) * n_row * n_unit * plan.n_split) / (kPartial * n_sm);
}

}  // namespace

AttentionPlan plan_attention(std::int64_t d_head, std::int64_t n_row, std::int64_t n_unit, std::int64_t n_key, int n_sm,
                             bool has_clusters) {
  AttentionPlan best;
  for (const cuda::AttentionShape& shape : cuda::kAttentionShapes) {
    if (shape.depth < d_head || (best.shape != nullptr && shape.depth > best.shape->depth)) continue;
    const std::int64_t most = std::min<std::int64_t>(ceil_div(n_key, 64), cuda::kMaxAttentionSplit);
    for (std::int64_t n_split = 1; n_split <= std::max<std::int64_t>(most, 1); ++n_split)
      for (const bool in_cluster : {false, true}) {
        if (in_cluster && !(has_clusters && shape.fits_cluster(n_split))) continue;
        AttentionPlan plan = {&shape, static_cast<int>(n_split), in_cluster};
        plan.us = microseconds(plan, {d_head, n_row, n_unit, n_key}, n_sm);
        if (best.shape == nullptr || plan.us < best.us) best = plan;
      }
  }
  return best;
}
AttentionPlan plan_attention(const CudaLowering& l, const AttentionOp& op) {
  const Shape& q = l.value(op.q.x).shape;
  const std::int64_t n_key = std::accumulate(op.n_key.begin(), op.n_key.end(), std::int64_t{0});
  if (op.rounds) {
    const std::int64_t n_head_kv = l.value(op.packed[0]).shape[1];
    return plan_attention(q[0], q[1] / n_head_kv * q[2], n_head_kv * q[3], n_key, l.n_sm,
                          l.is_hopper && l.ways.clusters);
  }
  const std::int64_t n_block = q[1] * q[3] * ceil_div(q[2], 8);  // a lower bound
  const std::int64_t most = std::min<std::int64_t>(ceil_div(n_key, 128), cuda::kMaxAttentionSplit);
  return {nullptr, static_cast<int>(std::clamp<std::int64_t>(l.n_sm / n_block, 1, most))};
}

}  // namespace vla::lower
