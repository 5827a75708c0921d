// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Times attention of full-size policies in every shape of blocks and split of the keys on the first GPU, on Hopper also
// in clusters and by wgmma, one JSON object a line: `us` of an attention with what combines its shares, `blocks_us`
// without a kernel that does. On the driver of tests the times say nothing.
#include <fmt/format.h>

#include <cmath>
#include <cstdio>
#include <numeric>
#include <random>

#include "base/bf16.h"
#include "cuda/kernels/hopper_flash.h"
#include "cuda/library/launch_timer.h"

namespace {

using namespace vla;
using namespace vla::cuda;
using test::cuda::LaunchTimer;

struct Size {
  const char* name;
  int n_query, n_head, n_head_kv, n_batch, d_head;
  std::vector<int> segments;
  bool has_mask = false, in_float32 = false;
};
const Size kSizes[] = {{"gr00t_n1_7 self", 41, 32, 32, 1, 48, {41}, false, true},
                       {"pi05 step", 50, 8, 1, 1, 256, {560, 50}},
                       {"pi05 prefix", 560, 8, 1, 1, 256, {560}},
                       {"pi05 vision", 256, 16, 16, 2, 72, {256}},
                       {"smolvla step", 50, 15, 5, 1, 64, {177, 50}, true},
                       {"smolvla step, prefix alone", 50, 15, 5, 1, 64, {177}},
                       {"smolvla prefix", 177, 15, 5, 1, 64, {177}, true},
                       {"smolvla vision", 1024, 12, 12, 2, 64, {1024}},
                       {"gr00t_n1_7 cross", 41, 32, 32, 1, 48, {200}},
                       {"gr00t_n1_7 language", 194, 16, 8, 1, 128, {194}, true},
                       {"gr00t_n1_7 vision", 256, 16, 16, 2, 64, {256}},
                       {"bitvla vision", 256, 16, 16, 2, 72, {256}, false, true},
                       {"bitvla language", 642, 20, 5, 1, 128, {642}}};
constexpr int kSplits[] = {1, 2, 3, 4, 5, 6, 8, 10, 13, 20};

std::size_t bytes(std::int64_t n) { return static_cast<std::size_t>(n); }

class Bench {
 public:
  explicit Bench(LaunchTimer timer) : timer_(std::move(timer)) {}

  Status run(const Size& size) {
    VLA_CHECK(run_type<std::uint16_t>(size, [](float x) { return to_bf16(x); }));
    return size.in_float32 ? run_type<float>(size, [](float x) { return x; }) : Status();
  }

 private:
  template <class T, class Convert>
  Status run_type(const Size& size, Convert convert) {
    const int n_key = std::accumulate(size.segments.begin(), size.segments.end(), 0);
    const std::int64_t n_row = std::int64_t{size.n_query} * size.n_head * size.n_batch;
    const std::int64_t n_of_keys = std::int64_t{size.d_head} * n_key * size.n_head_kv * size.n_batch;
    VLA_TRY(const Buffer q, random<T>(size.d_head * n_row, convert));
    VLA_TRY(const Buffer k, random<T>(n_of_keys, convert));
    VLA_TRY(const Buffer v, random<T>(n_of_keys, convert));
    const std::vector<float> hidden = mask_of(size.n_query, n_key);
    VLA_TRY(const Buffer mask, timer_.upload(std::as_bytes(std::span(hidden))));
    VLA_TRY(const Buffer y, timer_.gpu().allocate(bytes(4 * size.d_head * n_row), "y"));
    VLA_TRY(const Buffer partial,
            timer_.gpu().allocate(bytes(4 * (size.d_head + 2) * n_row * kMaxAttentionSplit), "partial sums"));

    AttentionJob job = {};
    const auto heads = [&](const Buffer& of, int first, int n_head, int n) {
      const std::int64_t token = std::int64_t{size.d_head} * n_head;
      return HeadRows{of.as<T>(bytes(first * token) * sizeof(T)), size.d_head, token, token * n};
    };
    job.q = heads(q, 0, size.n_head, size.n_query);
    int first = 0;
    for (const int n : size.segments) {
      job.segment[job.n_segment++] = {heads(k, first, size.n_head_kv, n_key), heads(v, first, size.n_head_kv, n_key),
                                      n};
      first += n;
    }
    job.mask = size.has_mask ? mask.as<float>() : nullptr;
    job.y = y.as<void>(), job.partial = partial.as<float>(), job.is_bf16 = sizeof(T) == 2;
    job.scale = 1 / std::sqrt(static_cast<float>(size.d_head));
    job.n_query = size.n_query, job.n_head = size.n_head, job.n_head_kv = size.n_head_kv, job.n_batch = size.n_batch;
    job.d_head = size.d_head;
    return run_shapes(size, job, n_key, sizeof(T) == 2);
  }

  /// The least depth of a table's shapes that heads fit.
  template <class Shapes>
  static int depth_of(const Shapes& shapes, const Size& size) {
    int depth = kMaxHead;
    for (const auto& shape : shapes)
      if (shape.depth >= size.d_head) depth = std::min(depth, shape.depth);
    return depth;
  }
  Status run_shapes(const Size& size, AttentionJob job, int n_key, bool is_bf16) {
    for (const int n_split : kSplits) {
      if (n_split > 1 && n_key / n_split < 32) continue;
      job.n_split = n_split;
      if (!is_bf16) {
        VLA_CHECK(tell(size, job, attention_f32(job)));
        continue;
      }
      for (const AttentionShape& shape : kAttentionShapes)
        if (shape.depth == depth_of(kAttentionShapes, size)) VLA_CHECK(run_shape(size, job, shape));
      for (const FlashShape& shape : kFlashShapes)
        if (shape.depth == depth_of(kFlashShapes, size)) VLA_CHECK(run_flash(size, job, shape));
    }
    return {};
  }
  /// Both ways to combine shares, if the device has clusters.
  Status run_shape(const Size& size, AttentionJob job, const AttentionShape& shape) {
    VLA_CHECK(tell(size, job, attention_bf16(shape, job)));
    if (!timer_.gpu().is_hopper() || !shape.fits_cluster(job.n_split)) return {};
    job.partial = nullptr;
    return tell(size, job, attention_bf16(shape, job));
  }
  /// If the device, the segments and the mask are such as the shape takes.
  Status run_flash(const Size& size, const AttentionJob& attention, const FlashShape& shape) {
    if (!timer_.gpu().is_hopper() || attention.n_segment > 1 || (size.has_mask && !shape.takes_mask)) return {};
    FlashJob job = {.k = {}, .v = {}, .attention = attention};
    VLA_CHECK(timer_.gpu().map_heads(mapped_heads(shape, attention, attention.segment[0].k), job.k));
    VLA_CHECK(timer_.gpu().map_heads(mapped_heads(shape, attention, attention.segment[0].v), job.v));
    return tell(size, attention, hopper_flash(shape, attention), &job);
  }

  Status tell(const Size& size, const AttentionJob& job, const Launch& how, const void* job_of_blocks = nullptr) {
    const LaunchTimer::JobLaunch launches[] = {{how, job_of_blocks != nullptr ? job_of_blocks : &job},
                                               {finish_attention(job), &job}};
    const std::span<const LaunchTimer::JobLaunch> all(launches, job.n_split > 1 && job.partial != nullptr ? 2 : 1);
    VLA_TRY(const float us, timer_.time(all));
    VLA_TRY(const float of_blocks, timer_.time(all.first(1)));
    fmt::print(
        R"({{"attention": "{}", "kernel": "{}", "grid": [{}, {}, {}], "splits": {}, "us": {:.2f}, "blocks_us": {:.2f}}})"
        "\n",
        size.name, how.kernel, how.grid.x, how.grid.y, how.grid.z, job.n_split, us, of_blocks);
    return {};
  }

  template <class T, class Convert>
  Result<Buffer> random(std::int64_t n, Convert convert) {
    std::vector<T> values(bytes(n));
    for (T& value : values) value = convert(normal_(random_));
    return timer_.upload(std::as_bytes(std::span(values)));
  }
  /// A query sees the keys up to its own of the last.
  static std::vector<float> mask_of(int n_query, int n_key) {
    std::vector<float> mask(bytes(std::int64_t{n_query} * n_key));
    for (int query = 0; query < n_query; ++query)
      for (int key = n_key - n_query + query + 1; key < n_key; ++key) mask[bytes(query * n_key + key)] = -INFINITY;
    return mask;
  }

  LaunchTimer timer_;
  std::mt19937 random_{7};
  std::normal_distribution<float> normal_{0, 1};
};

}  // namespace

int main(int n_argument, char** arguments) { return vla::test::cuda::run_bench<Bench>(kSizes, n_argument, arguments); }
