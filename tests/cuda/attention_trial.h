// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <algorithm>
#include <cstdlib>
#include <numeric>

#include "cuda/kernels/attention.h"
#include "cuda/machine.h"
#include "cuda/numbers.h"

/// Attention as kernels are asked for it, and in doubles.
namespace vla::test::cuda {

using vla::cuda::AttentionJob, vla::cuda::AttentionShape, vla::cuda::HeadRows;

struct AttentionCase {
  int n_query, n_head, n_head_kv, n_batch, d_head, n_split;
  std::vector<int> segments;
  bool has_mask = false;
  int n_hidden = 0;  // of a mask: keys at the end that every second query does not see; below 0: at the beginning
};
/// q, k and v as one projection leaves them: rows of all heads side by side, one token after the other. In bf16 a head
/// of NaN follows those of each token.
class AttentionTrial {
 public:
  explicit AttentionTrial(const AttentionCase& of) : c(of) {
    Numbers numbers;
    n_key = std::accumulate(c.segments.begin(), c.segments.end(), 0);
    q = rounded_to_bf16(numbers.floats(rows(c.n_head, c.n_query)));
    k = rounded_to_bf16(numbers.floats(rows(c.n_head_kv, n_key))),
    v = rounded_to_bf16(numbers.floats(rows(c.n_head_kv, n_key)));
    mask = numbers.floats(c.n_query * n_key);
    for (std::size_t i = 0; i < mask.size(); ++i)
      if (i % 7 == 3 && i % static_cast<std::size_t>(n_key) != 0) mask[i] = -INFINITY;
    for (int query = 0; query < c.n_query; query += 2)
      std::fill_n(mask.begin() + (c.n_hidden < 0 ? query * n_key : (query + 1) * n_key - c.n_hidden),
                  std::abs(c.n_hidden), -INFINITY);
  }

  std::vector<double> expected() const {
    std::vector<double> y(static_cast<std::size_t>(rows(c.n_head, c.n_query)));
    for (int b = 0; b < c.n_batch; ++b)
      for (int query = 0; query < c.n_query; ++query)
        for (int head = 0; head < c.n_head; ++head) {
          const int kv = head / (c.n_head / c.n_head_kv);
          std::vector<double> weight;
          for (int key = 0; key < n_key; ++key) {
            double dot = 0;
            for (int i = 0; i < c.d_head; ++i)
              dot += at(q, c.n_head, c.n_query, i, head, query, b) * at(k, c.n_head_kv, n_key, i, kv, key, b);
            dot /= std::sqrt(c.d_head);
            if (c.has_mask) dot += static_cast<double>(mask[static_cast<std::size_t>(query * n_key + key)]);
            weight.push_back(std::exp(dot));
          }
          const double total = std::accumulate(weight.begin(), weight.end(), 0.0);
          for (int i = 0; i < c.d_head; ++i) {
            double sum = 0;
            for (int key = 0; key < n_key; ++key)
              sum += weight[static_cast<std::size_t>(key)] / total * at(v, c.n_head_kv, n_key, i, kv, key, b);
            y[place(c.n_head, c.n_query, i, head, query, b)] = sum;
          }
        }
    return y;
  }

  /// y by the kernel that `start` launches. in_cluster: no other kernel combines shares.
  template <class Start>
  std::vector<float> run_bf16(Start start, bool y_is_bf16, bool in_cluster = false) const {
    const auto convert = [&](const std::vector<float>& of, int n_head) {
      return bf16_rows(of, n_head * c.d_head, (n_head + 1) * c.d_head);
    };
    return run<std::uint16_t>(start, y_is_bf16, convert, 1, in_cluster);
  }
  template <class Start>
  std::vector<float> run_f32(Start start) const {
    return run<float>(
        start, false, [](const std::vector<float>& of, int) { return of; }, 0, false);
  }

  AttentionCase c;

 private:
  /// n_more: heads behind those of a token.
  template <class T, class Start, class Convert>
  std::vector<float> run(Start start, bool y_is_bf16, Convert convert, int n_more, bool in_cluster) const {
    const Device<T> gq(convert(q, c.n_head)), gk(convert(k, c.n_head_kv)), gv(convert(v, c.n_head_kv));
    const Device<float> gmask(mask), y(q.size());
    const Device<std::uint16_t> half(q.size());
    AttentionJob job = {};
    const auto heads = [&](const T* data, int n_head, int n) {
      const std::int64_t token = std::int64_t{c.d_head} * (n_head + n_more);
      return HeadRows{data, c.d_head, token, token * n};
    };
    job.q = heads(gq.get(), c.n_head, c.n_query);
    int first = 0;
    for (int n : c.segments) {
      const std::int64_t at = std::int64_t{first} * (c.n_head_kv + n_more) * c.d_head;
      job.segment[job.n_segment++] = {heads(gk.get() + at, c.n_head_kv, n_key),
                                      heads(gv.get() + at, c.n_head_kv, n_key), n};
      first += n;
    }
    job.mask = c.has_mask ? gmask.get() : nullptr;
    job.y = y_is_bf16 ? static_cast<void*>(half.get()) : y.get(), job.is_bf16 = y_is_bf16;
    job.scale = 1 / std::sqrt(static_cast<float>(c.d_head));
    job.n_query = c.n_query, job.n_head = c.n_head, job.n_head_kv = c.n_head_kv, job.n_batch = c.n_batch;
    job.d_head = c.d_head, job.n_split = c.n_split;
    const Device<float> partial(
        static_cast<std::size_t>((c.d_head + 2) * c.n_head * c.n_query * c.n_batch * c.n_split));
    job.partial = in_cluster ? nullptr : partial.get();
    start(job);
    if (c.n_split > 1 && !in_cluster) launch(vla::cuda::finish_attention(job), job);
    return y_is_bf16 ? widened(half.host()) : y.host();
  }

  std::int64_t rows(int n_head, int n) const { return std::int64_t{c.d_head} * n_head * n * c.n_batch; }
  std::size_t place(int n_head, int n, int i, int head, int token, int b) const {
    return static_cast<std::size_t>(((b * n + token) * n_head + head) * c.d_head + i);
  }
  double at(const std::vector<float>& of, int n_head, int n, int i, int head, int token, int b) const {
    return static_cast<double>(of[place(n_head, n, i, head, token, b)]);
  }

  int n_key = 0;
  std::vector<float> q, k, v, mask;
};

/// The least depth of a shape that heads fit.
inline int depth_of(int d_head) {
  int least = 256;
  for (const AttentionShape& shape : vla::cuda::kAttentionShapes)
    if (shape.depth >= d_head) least = std::min(least, shape.depth);
  return least;
}

}  // namespace vla::test::cuda
