// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/attention_tile.h"

namespace vla::cuda {
namespace {

/// Each warp takes all keys for its rows. The next tile is copied while one is computed.
template <class S>
VLA_DEVICE void attend_alone(const AttentionJob& job) {
  std::byte *q = dev::shared_memory(), *stages = q + S::kRows * S::kRow;
  const Unit unit(job);
  const KeyShare share(job);
  KeyReader<S, &AttentionJob::Segment::k> keys(job, unit);
  KeyReader<S, &AttentionJob::Segment::v> values(job, unit);
  const auto fetch = [&](int first, int stage) {
    keys.fetch(first, share.last, stages + stage * 2 * S::kTile);
    values.fetch(first, share.last, stages + (stage * 2 + 1) * S::kTile);
  };
  dev::wait_for_earlier();
  clear_columns<S>(job.d_head, S::kRows + 4 * S::kKeys, q);
  fetch_queries<S>(job, unit, static_cast<int>(blockIdx.x) * S::kRows, q);
  if (share.first < share.last) fetch(share.first, 0);
  dev::commit_copies();

  AttentionWarp<S> warp(job, unit, share.n_key);
  int stage = 0;
  for (int first = share.first; first < share.last; first += S::kKeys, stage ^= 1) {
    if (first + S::kKeys < share.last) fetch(first + S::kKeys, stage ^ 1);
    dev::commit_copies();
    warp.begin_scores(first, share.last);
    dev::wait_copies<1>();
    __syncthreads();  // the tile is visible to all threads
    if (first == share.first) warp.keep_queries(q);
    warp.unscale_mask();
    const std::byte* k = stages + stage * 2 * S::kTile;
    warp.score(q, k);
    float most[2];
    warp.find_most(most);
    warp.shrink_to(most);
    warp.add_values_alone(k + S::kTile);
    __syncthreads();  // all threads have read the stage that is overwritten next
  }
  dev::let_next_begin();
  dev::wait_copies<0>();
  warp.complete(nullptr);
  warp.store_rows();
}

template <int kIndex>
VLA_DEVICE void attend_bf16(const AttentionJob& job) {
  using S = AttentionBlock<kIndex>;
  if constexpr (S::kShares)
    attend_shared<S>(job, Unit(job), [](const AttentionWarp<S>& warp) { warp.store_rows(); });
  else
    attend_alone<S>(job);
}

}  // namespace

// In the order of kAttentionShapes.
VLA_EARLY_KERNEL(attention_bf16_64, 128, 3, AttentionJob) { attend_bf16<0>(job); }
VLA_EARLY_KERNEL(attention_bf16_64_32, 256, 2, AttentionJob) { attend_bf16<1>(job); }
VLA_EARLY_KERNEL(attention_bf16_64_16, 256, 2, AttentionJob) { attend_bf16<2>(job); }
VLA_EARLY_KERNEL(attention_bf16_80, 128, 2, AttentionJob) { attend_bf16<3>(job); }
VLA_EARLY_KERNEL(attention_bf16_128, 128, 2, AttentionJob) { attend_bf16<4>(job); }
VLA_EARLY_KERNEL(attention_bf16_128_32, 256, 2, AttentionJob) { attend_bf16<5>(job); }
VLA_EARLY_KERNEL(attention_bf16_128_16, 256, 2, AttentionJob) { attend_bf16<6>(job); }
VLA_EARLY_KERNEL(attention_bf16_256, 256, 1, AttentionJob) { attend_bf16<7>(job); }
VLA_EARLY_KERNEL(attention_bf16_256_32, 256, 2, AttentionJob) { attend_bf16<8>(job); }

}  // namespace vla::cuda
