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

/// Rates of attention by wgmma, which nobody has measured. Products: an assumption, a half of what an H200 multiplies
/// at most. Two blocks of 64 rows share an SM.
constexpr AttentionRates kFlash = {.tile = 0.3, .products = 1.9e6, .further = 0.6};

/// What attention computes, as plan_attention is told it.
struct AttentionSize {
  std::int64_t d_head, n_row, n_unit, n_key;
};

/// The time of a kernel of its own that combines shares.
double combine_apart_us(const AttentionSize& size, int n_split, int n_sm) {
  const std::int64_t n_partial = (size.d_head + 2) * size.n_row * size.n_unit * n_split;
  return n_split == 1 ? 0 : kCombine + 8.0 * static_cast<double>(n_partial) / (kPartial * n_sm);
}

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
  return us + (plan.in_cluster ? 0 : combine_apart_us(size, plan.n_split, n_sm));
}
/// The same by wgmma.
double flash_microseconds(const AttentionPlan& plan, const AttentionSize& size, int n_sm) {
  const cuda::FlashShape& shape = *plan.flash;
  const std::int64_t n_block = ceil_div(size.n_row, shape.rows) * size.n_unit * plan.n_split;
  const std::int64_t n_tile = ceil_div(ceil_div(size.n_key, plan.n_split), shape.keys);
  const double products = 2.0 * shape.rows * shape.keys * shape.depth;
  const double block = static_cast<double>(n_tile) * (kFlash.tile + products / kFlash.products);
  const double further = shape.shares_sm() ? kFlash.further : 1;
  const double each = 1 + further * static_cast<double>(ceil_div(n_block, n_sm) - 1);
  return kStart + each * block + combine_apart_us(size, plan.n_split, n_sm);
}
std::int64_t most_shares(std::int64_t n_key) {
  return std::clamp<std::int64_t>(ceil_div(n_key, 64), 1, cuda::kMaxAttentionSplit);
}

/// Whether TMA can map heads of these strides.
bool can_map(const Value& rows) {
  const Shape &shape = rows.shape, &stride = rows.stride;
  return stride[1] % 8 == 0 && stride[2] % stride[1] == 0 && stride[3] % stride[2] == 0 && stride[1] >= shape[0] &&
         stride[2] >= stride[1] * shape[1] && stride[3] >= stride[2] * shape[2];
}

}  // namespace

AttentionPlan plan_attention(std::int64_t d_head, std::int64_t n_row, std::int64_t n_unit, std::int64_t n_key, int n_sm,
                             bool has_clusters) {
  AttentionPlan best;
  for (const cuda::AttentionShape& shape : cuda::kAttentionShapes) {
    if (shape.depth < d_head || (best.shape != nullptr && shape.depth > best.shape->depth)) continue;
    for (std::int64_t n_split = 1; n_split <= most_shares(n_key); ++n_split)
      for (const bool in_cluster : {false, true}) {
        if (in_cluster && !(has_clusters && shape.fits_cluster(n_split))) continue;
        AttentionPlan plan = {.shape = &shape, .n_split = static_cast<int>(n_split), .in_cluster = in_cluster};
        plan.us = microseconds(plan, {d_head, n_row, n_unit, n_key}, n_sm);
        if (best.shape == nullptr || plan.us < best.us) best = plan;
      }
  }
  return best;
}
AttentionPlan plan_flash(std::int64_t d_head, std::int64_t n_row, std::int64_t n_unit, std::int64_t n_key, int n_sm,
                         bool has_mask) {
  AttentionPlan best;
  for (const cuda::FlashShape& shape : cuda::kFlashShapes) {
    if (shape.depth < d_head || (best.flash != nullptr && shape.depth > best.flash->depth)) continue;
    if (has_mask && !shape.takes_mask) continue;
    for (std::int64_t n_split = 1; n_split <= most_shares(n_key); ++n_split) {
      AttentionPlan plan = {.flash = &shape, .n_split = static_cast<int>(n_split)};
      plan.us = flash_microseconds(plan, {d_head, n_row, n_unit, n_key}, n_sm);
      if (best.flash == nullptr || plan.us < best.us) best = plan;
    }
  }
  return best;
}
AttentionPlan plan_attention(const CudaLowering& l, const AttentionOp& op) {
  const Shape& q = l.value(op.q.x).shape;
  const std::int64_t n_key = std::accumulate(op.n_key.begin(), op.n_key.end(), std::int64_t{0});
  if (op.rounds) {
    const std::int64_t n_head_kv = l.value(op.packed[0]).shape[1];
    const std::int64_t n_row = q[1] / n_head_kv * q[2], n_unit = n_head_kv * q[3];
    const AttentionPlan plan = plan_attention(q[0], n_row, n_unit, n_key, l.n_sm, l.is_hopper && l.ways.clusters);
    const bool can_flash = l.is_hopper && l.ways.flash && op.n_key.size() == 1 && can_map(l.value(op.packed[0])) &&
                           can_map(l.value(op.packed[1]));
    if (!can_flash) return plan;
    const AttentionPlan flash = plan_flash(q[0], n_row, n_unit, n_key, l.n_sm, op.mask != kNone);
    return flash.us < plan.us ? flash : plan;
  }
  const std::int64_t n_block = q[1] * q[3] * ceil_div(q[2], 8);  // a lower bound
  const std::int64_t most = std::min<std::int64_t>(ceil_div(n_key, 128), cuda::kMaxAttentionSplit);
  return {.n_split = static_cast<int>(std::clamp<std::int64_t>(l.n_sm / n_block, 1, most))};
}

}  // namespace vla::lower
