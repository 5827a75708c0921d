// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/hopper_flash.h"

#include "cuda/kernels/attention_tile.h"
#include "cuda/kernels/hopper.h"

namespace vla::cuda {
namespace {

template <int kIndex>
struct FlashBlock {
  static constexpr FlashShape kOf = kFlashShapes[kIndex];
  static constexpr int kDepth = kOf.depth, kRows = kOf.rows, kKeys = kOf.keys, kTile = kOf.tile();
  static constexpr int kMultipliers = kRows * 2;  // threads; those of the last warp fetch
  static constexpr unsigned kStages = FlashShape::kStages;
  static constexpr int kBarriers = FlashShape::kBarriers;
  static constexpr int kColumns = kOf.columns(), kRow = kColumns * 2;  // of a swizzled row; kRow: bytes
  // As AttentionBlock, for AttentionWarp.
  static constexpr int kRowGroups = kRows / 16, kOwnKeys = kKeys, kSteps = kDepth / 16;
  static constexpr int kTiles = kDepth / 8, kSums = 1;
  static constexpr bool kTakesMask = kOf.takes_mask, kShares = false, kKeepsQ = false;
  static_assert(kOf.shared() <= static_cast<int>(kHopperShared) && kKeys % 16 == 0 && kTile % 1024 == 0);
};

/// Tiles of keys and values, numbered in the order in which they are fetched and multiplied, take turns in shared
/// memory. A place's `full` ends a phase when a tile is there, its `empty` when all warps that multiply have read it.
template <class S>
struct Tiles {
  std::byte* first;

  VLA_DEVICE std::byte* tile(unsigned n) const { return first + n % S::kStages * S::kTile; }
  VLA_DEVICE std::byte* full(unsigned n) const { return first + S::kStages * S::kTile + n % S::kStages * S::kBarriers; }
  VLA_DEVICE std::byte* empty(unsigned n) const { return full(n) + 8; }
  static VLA_DEVICE unsigned parity(unsigned n) { return n / S::kStages % 2; }
  /// For one thread of a block.
  VLA_DEVICE void begin() const {
    for (unsigned n = 0; n < S::kStages; ++n)
      dev::begin_mbarrier(full(n), 1), dev::begin_mbarrier(empty(n), S::kRowGroups);
    dev::fence_mbarriers();
  }
  /// Says that this warp has read a tile.
  VLA_DEVICE void leave(unsigned n) const {
    if (thread_index() % kLanes == 0) dev::arrive(empty(n));
  }
};

/// A block's tiles of keys and values.
template <class S>
class Fetch {
 public:
  VLA_DEVICE Fetch(const FlashJob& job, const Unit& unit, const KeyShare& share, Tiles<S> to)
      : job_(job), unit_(unit), share_(share), to_(to) {}

  /// Fetches the keys of tiles `begin` to end - 1, and after those of a tile the values of the one before it.
  VLA_DEVICE void run(int begin, int end, int n_tile) {
    for (int i = begin; i < end; ++i) {
      if (i < n_tile) fetch(job_.k, i);
      if (i > 0) fetch(job_.v, i - 1);
    }
  }

 private:
  VLA_DEVICE void fetch(const TensorMap& map, int tile) {
    dev::wait_mbarrier(to_.empty(next_), to_.parity(next_) ^ 1);
    dev::arrive_expecting(to_.full(next_), S::kTile);
#pragma unroll
    for (int column = 0; column < S::kDepth; column += S::kColumns)
      dev::copy_box_of_head(to_.tile(next_) + column * S::kKeys * 2, map, column, unit_.head_kv,
                            share_.first + tile * S::kKeys, unit_.batch, to_.full(next_));
    ++next_;
  }

  const FlashJob& job_;
  const Unit& unit_;
  const KeyShare& share_;
  Tiles<S> to_;
  unsigned next_ = 0;
};

/// Copies a block's rows of queries, swizzled, with zeros after the last and in the columns from d_head on.
template <class S>
VLA_DEVICE void copy_queries(const AttentionJob& job, const Unit& unit, std::byte* to) {
  constexpr int kChunks = S::kDepth / 8, kOfRow = S::kColumns / 8;
  for (int i = thread_index(); i < S::kRows * kChunks; i += S::kMultipliers) {
    const int of_block = i / kChunks, chunk = i % kChunks;
    const int row = static_cast<int>(blockIdx.x) * S::kRows + of_block;
    const bool is_there = row < job.n_row() && chunk * 8 < job.d_head;
    const auto* from = row_of<std::uint16_t>(job.q, head_of(job, unit, row), query_of(job, row), unit.batch);
    dev::copy_async(to + chunk / kOfRow * S::kRows * S::kRow + swizzled<S::kRow>(of_block, chunk % kOfRow),
                    is_there ? from + chunk * 8 : job.q.data, is_there ? 16 : 0);
  }
  dev::commit_copies();
  dev::wait_copies<0>();
  dev::fence_async_proxy();
}

/// A warp's part of a warpgroup's 64 rows. The scores of a tile and the values of the one before it are multiplied
/// together, and what weights follow from the scores while values are still multiplied.
template <class S>
class FlashWarp : AttentionWarp<S> {
  using Base = AttentionWarp<S>;
  using Base::job_, Base::scores_, Base::y_, Base::most_, Base::total_;

 public:
  VLA_DEVICE FlashWarp(const AttentionJob& job, const Unit& unit, const KeyShare& share, const std::byte* q,
                       Tiles<S> tiles)
      : Base(job, unit, share.n_key), share_(share), tiles_(tiles) {
    q_ = swizzled_descriptor<S::kRow>(q + thread_index() / 128 * 64 * S::kRow);
  }

  VLA_DEVICE void run() {
    int first = share_.first;
    if (first < share_.last) {
      multiply_keys(first);
      dev::wgmma_wait_for<0>(scores());
      tiles_.leave(next_ - 1);
      float factor[2];
      weigh(factor);
      round_weights();
      while ((first += S::kKeys) < share_.last) {
        multiply_keys(first);
        multiply_values();
        dev::wgmma_wait_for<1>(scores());
        tiles_.leave(next_ - 2);
        weigh(factor);
        dev::wgmma_wait_for<0>(values());
        tiles_.leave(next_ - 1);
        shrink(factor);
        round_weights();
        dev::pin(values());
      }
      multiply_values();
      dev::wgmma_wait_for<0>(values());
    }
    dev::let_next_begin();
    Base::complete(nullptr);
    Base::store_rows();
  }

 private:
  /// Registers of products, in wgmma's order.
  VLA_DEVICE float (&scores())[S::kKeys / 2] { return reinterpret_cast<float(&)[S::kKeys / 2]>(scores_); }
  VLA_DEVICE float (&values())[S::kDepth / 2] { return reinterpret_cast<float(&)[S::kDepth / 2]>(y_); }

  VLA_DEVICE const std::byte* wait_for_next() {
    dev::wait_mbarrier(tiles_.full(next_), tiles_.parity(next_));
    return tiles_.tile(next_++);
  }
  /// scores = mask + q k of the next tile, which begins at key `first`.
  VLA_DEVICE void multiply_keys(int first) {
    constexpr int kOfRow = S::kColumns / 16;
    Base::begin_scores(first, share_.last);
    const std::uint64_t k = swizzled_descriptor<S::kRow>(wait_for_next());
    Base::unscale_mask();
    dev::pin(scores());
    dev::wgmma_fence();
#pragma unroll
    for (int i = 0; i < S::kSteps; ++i) {
      const int piece = i / kOfRow * S::kRow / 16, within = i % kOfRow * 2;
      dev::wgmma_bf16<S::kKeys>(scores(), q_ + piece * S::kRows + within, k + piece * S::kKeys + within, true);
    }
    dev::wgmma_commit();
  }
  /// y += weights v of the next tile.
  VLA_DEVICE void multiply_values() {
    const std::uint64_t v = swizzled_descriptor<S::kRow>(wait_for_next(), S::kKeys * S::kRow);
    dev::wgmma_fence();
#pragma unroll
    for (int i = 0; i < S::kKeys / 16; ++i) dev::wgmma_bf16<S::kDepth>(values(), weights_[i], v + i * S::kRow);
    dev::wgmma_commit();
  }
  /// Replaces scores by weights. Sums of what came before must be multiplied by the rows' factors.
  VLA_DEVICE void weigh(float (&factor)[2]) {
    float most[2];
    Base::find_most(most);
    const float scale = job_.scale * kLog2;
#pragma unroll
    for (int h = 0; h < 2; ++h) {
      const float base = finite(most[h]) * scale;
      factor[h] = dev::power_of_two(most_[h] * scale - base);
      most_[h] = most[h], total_[h] *= factor[h];
#pragma unroll
      for (int n = 0; n < S::kKeys / 8; ++n) {
        float &low = scores_[n][2 * h], &high = scores_[n][2 * h + 1];
        low = dev::power_of_two(low * scale - base), high = dev::power_of_two(high * scale - base);
        total_[h] += low + high;
      }
    }
  }
  VLA_DEVICE void shrink(const float (&factor)[2]) {
#pragma unroll
    for (int n = 0; n < S::kTiles; ++n)
#pragma unroll
      for (int c = 0; c < 4; ++c) y_[0][n][c] *= factor[c / 2];
  }
  /// Rounds weights to operands of the product with values.
  VLA_DEVICE void round_weights() {
#pragma unroll
    for (int n = 0; n < S::kKeys / 8; ++n)
#pragma unroll
      for (int h = 0; h < 2; ++h)
        weights_[n / 2][n % 2 * 2 + h] = dev::to_bf16(scores_[n][2 * h], scores_[n][2 * h + 1]);
  }

  const KeyShare& share_;
  std::uint64_t q_;  // descriptor of the warpgroup's queries
  Tiles<S> tiles_;
  unsigned next_ = 0;  // the next tile to multiply
  unsigned weights_[S::kKeys / 16][4];
};

template <int kIndex>
VLA_DEVICE void attend(const FlashJob& job) {
  using S = FlashBlock<kIndex>;
  std::byte* q = dev::shared_memory();
  const Tiles<S> tiles = {q + S::kRows * S::kDepth * 2};
  const Unit unit(job.attention);
  const KeyShare share(job.attention);
  if (thread_index() == 0) tiles.begin();
  __syncthreads();  // mbarriers have begun
  dev::wait_for_earlier();
  if (thread_index() < S::kMultipliers) {
    copy_queries<S>(job.attention, unit, q);
    __syncthreads();  // queries are there
    FlashWarp<S>(job.attention, unit, share, q, tiles).run();
  } else {
    const bool is_first = thread_index() == S::kMultipliers;
    const int n_tile = (share.last - share.first + S::kKeys - 1) / S::kKeys;
    Fetch<S> fetch(job, unit, share, tiles);
    if (is_first) fetch.run(0, n_tile < 1 ? 1 : 2, n_tile);  // waits for nobody
    __syncthreads();                                         // queries are there
    if (is_first) fetch.run(2, n_tile + 1, n_tile);
  }
}

}  // namespace

// By their index in kFlashShapes.
VLA_EARLY_KERNEL(hopper_flash_64x64, 160, 2, FlashJob) { attend<0>(job); }
VLA_EARLY_KERNEL(hopper_flash_64x128, 288, 1, FlashJob) { attend<1>(job); }
VLA_EARLY_KERNEL(hopper_flash_80x64, 160, 2, FlashJob) { attend<2>(job); }
VLA_EARLY_KERNEL(hopper_flash_80x128, 288, 1, FlashJob) { attend<3>(job); }
VLA_EARLY_KERNEL(hopper_flash_128x64, 160, 2, FlashJob) { attend<4>(job); }
VLA_EARLY_KERNEL(hopper_flash_128x128, 288, 1, FlashJob) { attend<5>(job); }
VLA_EARLY_KERNEL(hopper_flash_256x64, 160, 1, FlashJob) { attend<6>(job); }

}  // namespace vla::cuda
