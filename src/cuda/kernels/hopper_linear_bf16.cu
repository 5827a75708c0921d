// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/halved_norm.h"
#include "cuda/kernels/hopper_tile.h"

namespace vla::cuda {
namespace {

template <int kColumns_, int kRows_, bool kGated_, bool kBegins_ = false>
struct Tile {
  static constexpr bool kBegins = kBegins_;  // whether it begins a norm
  static constexpr bool kGated = kGated_;
  static constexpr int kColumns = kColumns_, kRows = kRows_, kThreads = kColumns * 2;
  static constexpr int kStages = hopper_stages(kColumns, kRows), kStage = hopper_stage_bytes(kColumns, kRows);
  static constexpr int kBytesW = kColumns * kSwizzledRow;
  static constexpr int kColumnsY = kGated ? kColumns / 2 : kColumns;
};

/// Begins a norm of y.
struct BeginsNorm {
  static constexpr bool kTakesRows = true;
  const LinearBf16Job& job;
  VLA_DEVICE void operator()(int row, int column, const float (&y)[4]) const { begin_norm<16, 4>(job, row, column, y); }
};

template <class T>
VLA_DEVICE void multiply(const LinearBf16Job& job, int block) {
  std::byte* shared = dev::shared_memory();
  const int row0 = static_cast<int>(blockIdx.x) * T::kRows, column0 = block * T::kColumnsY;
  const int n_step = (job.depth + kHopperDepth - 1) / kHopperDepth, z = static_cast<int>(blockIdx.z);
  const int first = n_step * z / job.n_split, n = n_step * (z + 1) / job.n_split - first;
  // Rows of the gate's matrix come first.
  const FetchRows<T::kColumnsY, T::kThreads> fetch_matrix(job.weight, job.weight_stride * 2, column0, job.n_column,
                                                          job.depth * 2);
  const FetchRows<T::kColumnsY, T::kThreads> fetch_gate(job.gate_weight, job.weight_stride * 2, column0, job.n_column,
                                                        job.depth * 2);
  const auto fetch_w = [&](std::byte* stage, int step) {
    if constexpr (T::kGated) fetch_gate(stage, step);
    fetch_matrix(stage + (T::kColumns - T::kColumnsY) * kSwizzledRow, step);
  };
  const FetchRows<T::kRows, T::kThreads> fetch_x(job.x, job.x_stride * 2, row0, job.n_row_x(), job.depth * 2);

  float sum[T::kRows / 2] = {};
#pragma unroll
  for (int i = 0; i < T::kStages - 2; ++i)
    if (i < n) fetch_w(shared + i * T::kStage, first + i);
  dev::wait_for_earlier();
#pragma unroll
  for (int i = 0; i < T::kStages - 2; ++i) {
    if (i < n) fetch_x(shared + i * T::kStage + T::kBytesW, first + i);
    dev::commit_copies();  // commits a group even if it is empty, because waiting counts groups
  }
  const RowTerms terms = thread_index() < T::kRows ? terms_of_row(job, row0 + thread_index()) : RowTerms();
  const std::uint64_t of_stage = T::kStage / 16;
  const std::uint64_t w0 = swizzled_descriptor(shared + thread_index() / 128 * 64 * kSwizzledRow);
  const std::uint64_t x0 = swizzled_descriptor(shared + T::kBytesW);
  int stage = 0, next = T::kStages - 2;
  int i = 0;
#pragma unroll 1
  do {
    dev::wait_copies<T::kStages - 3>();
    dev::fence_async_proxy();
    __syncthreads();  // all warpgroups may multiply the stage, and have multiplied the one that is overwritten next
    const std::uint64_t w = w0 + stage * of_stage, x = x0 + stage * of_stage;
    dev::wgmma_fence();
#pragma unroll
    for (int k = 0; k < 4; ++k) dev::wgmma_bf16<T::kRows>(sum, w + 2 * k, x + 2 * k, i + k > 0);
    dev::wgmma_commit();
    if (const int ahead = i + T::kStages - 2; ahead < n) {
      fetch_w(shared + next * T::kStage, first + ahead);
      fetch_x(shared + next * T::kStage + T::kBytesW, first + ahead);
    }
    dev::commit_copies();
    dev::wgmma_wait<1>();
    stage = stage + 1 == T::kStages ? 0 : stage + 1;
    next = next + 1 == T::kStages ? 0 : next + 1;
  } while (++i < n);

  dev::let_next_begin();
  dev::wgmma_wait_all(sum);
  dev::wait_copies<0>();
  __syncthreads();  // the stages' memory is reused for sums
  using End = TileEnd<float, T::kColumns, T::kRows, T::kGated>;
  End::place(sum, shared);
  std::byte* const all_terms = shared + T::kRows * (T::kColumns + 4) * 4;
  static_assert(T::kRows <= T::kThreads && T::kRows * (T::kColumns + 6) * 4 <= T::kStages * T::kStage);
  if (thread_index() < T::kRows) dev::write(all_terms + thread_index() * sizeof(RowTerms), terms);
  const End end(job, job.gate_bias, job.partial ? job.n_row_x() : job.n_row, row0, column0);
  const auto terms_of = [&](int row) { return dev::read<RowTerms>(all_terms + (row - row0) * sizeof(RowTerms)); };
  const EndsNorm<T::kGated ? 2 : 1> ends = {job};
  if constexpr (T::kBegins)
    end.finish(shared, terms_of, ends, BeginsNorm{job});
  else if (job.partial)
    end.leave(
        shared, job.partial + static_cast<std::int64_t>(z) * job.n_row_x() * job.n_sum(), [](int) { return 0; },
        [](int, float of_column) { return static_cast<unsigned>(dev::bits_of(of_column)); });
  else
    end.finish(shared, terms_of, ends);
}

}  // namespace

#define VLA_HOPPER_KERNEL(columns, rows)                                                            \
  VLA_EARLY_KERNEL(hopper_linear_bf16_##columns##x##rows##_begins, columns * 2, 1, LinearBf16Job) { \
    multiply<Tile<columns, rows, false, true>>(job, static_cast<int>(blockIdx.y));                  \
  }
VLA_HOPPER_BEGINNING_TILES(VLA_HOPPER_KERNEL)
#undef VLA_HOPPER_KERNEL
#define VLA_HOPPER_KERNEL(columns, rows)                                                   \
  VLA_EARLY_KERNEL(hopper_linear_bf16_##columns##x##rows, columns * 2, 1, LinearBf16Job) { \
    multiply<Tile<columns, rows, false>>(job, static_cast<int>(blockIdx.y));               \
  }
VLA_HOPPER_TILES(VLA_HOPPER_KERNEL)
#undef VLA_HOPPER_KERNEL
#define VLA_HOPPER_KERNEL(columns, rows)                                                           \
  VLA_EARLY_KERNEL(hopper_linear_bf16_##columns##x##rows##_gated, columns * 2, 1, LinearBf16Job) { \
    multiply<Tile<columns, rows, true>>(job, static_cast<int>(blockIdx.y));                        \
  }
VLA_HOPPER_GATED_TILES(VLA_HOPPER_KERNEL)
#undef VLA_HOPPER_KERNEL
#define VLA_HOPPER_KERNEL(columns, rows)                                                                    \
  VLA_EARLY_KERNEL(hopper_linears_bf16_##columns##x##rows, columns * 2, 1, Several<LinearBf16Job>) {        \
    run_one(job, blockIdx.y,                                                                                \
            [](const LinearBf16Job& one, int block) { multiply<Tile<columns, rows, false>>(one, block); }); \
  }
VLA_HOPPER_BEGINNING_TILES(VLA_HOPPER_KERNEL)
VLA_HOPPER_SEVERAL_TILES(VLA_HOPPER_KERNEL)
#undef VLA_HOPPER_KERNEL

}  // namespace vla::cuda
