// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/attention.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <numeric>

#include "cuda/machine.h"
#include "cuda/numbers.h"

namespace attention_test {

using namespace vla;
using namespace vla::cuda;
using namespace vla::test::cuda;

namespace {

struct Case {
  int n_query, n_head, n_head_kv, n_batch, d_head, n_split;
  std::vector<int> segments;
  bool has_mask = false;
  int n_hidden = 0;  // of a mask: keys at the end that every second query does not see
};
// Towers (72 and 80 wide, a batch of views), grouped heads, a prefix of keys before the step's own, few queries with
// keys split, the widest head, heads that no tile divides, and keys of several tiles in segments that end within them.
const Case kCases[] = {{70, 2, 2, 2, 72, 1, {70}},
                       {65, 4, 2, 1, 80, 1, {65}},
                       {16, 8, 2, 1, 64, 1, {41, 16}, true},
                       {50, 2, 1, 1, 128, 1, {130}},
                       {5, 8, 1, 1, 256, 3, {100, 0, 5}, true},
                       {1, 2, 2, 1, 24, 4, {33, 1}},
                       {7, 6, 2, 2, 64, 1, {200, 0, 60, 70}, true},
                       {11, 6, 2, 1, 40, 2, {90, 41}},
                       {9, 4, 1, 2, 128, 2, {70, 210}, true},
                       {4, 10, 1, 1, 256, 1, {70, 63}, true}};
// For every depth of a cluster's kernels: shares without keys, shares of which some rows see nothing, rows that fill no
// tile or end in one, heads that are less than the depth, and clusters of as many blocks as there may be.
const Case kClusterCases[] = {
    {9, 6, 2, 2, 40, 8, {100, 0, 60}, true, 70}, {13, 4, 1, 1, 64, 3, {290, 5}},         {1, 2, 2, 1, 24, 5, {33, 1}},
    {5, 8, 2, 1, 128, 2, {70, 150}, true},       {19, 2, 1, 2, 96, 7, {200}, true, 90},  {33, 1, 1, 1, 256, 5, {300}},
    {4, 10, 1, 1, 200, 8, {70, 63}, true, 60},   {5, 8, 1, 2, 256, 3, {100, 0, 5}, true}};

/// q, k and v as one projection leaves them: rows of all heads side by side, one token after the other.
class Trial {
 public:
  explicit Trial(const Case& of) : c(of) {
    Numbers numbers;
    n_key = std::accumulate(c.segments.begin(), c.segments.end(), 0);
    q = rounded_to_bf16(numbers.floats(rows(c.n_head, c.n_query)));
    k = rounded_to_bf16(numbers.floats(rows(c.n_head_kv, n_key))),
    v = rounded_to_bf16(numbers.floats(rows(c.n_head_kv, n_key)));
    mask = numbers.floats(c.n_query * n_key);
    for (std::size_t i = 0; i < mask.size(); ++i)
      if (i % 7 == 3 && i % static_cast<std::size_t>(n_key) != 0) mask[i] = -INFINITY;
    for (int query = 0; query < c.n_query; query += 2)
      std::fill_n(mask.begin() + (query + 1) * n_key - c.n_hidden, c.n_hidden, -INFINITY);
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

  /// y by the kernel that `how` launches, of elements that `convert` makes. in_cluster: no other kernel combines
  /// shares.
  template <class T, class How, class Convert>
  std::vector<float> run(How how, bool y_is_bf16, Convert convert, bool in_cluster = false) const {
    const Device<T> gq(convert(q)), gk(convert(k)), gv(convert(v));
    const Device<float> gmask(mask), y(q.size());
    const Device<std::uint16_t> half(q.size());
    AttentionJob job = {};
    const auto heads = [&](const T* data, int n_head, int n) {
      return HeadRows{data, c.d_head, std::int64_t{c.d_head} * n_head, std::int64_t{c.d_head} * n_head * n};
    };
    job.q = heads(gq.get(), c.n_head, c.n_query);
    int first = 0;
    for (int n : c.segments) {
      const std::int64_t at = std::int64_t{first} * c.n_head_kv * c.d_head;
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
    launch(how(job), job);
    if (c.n_split > 1 && !in_cluster) launch(finish_attention(job), job);
    return y_is_bf16 ? widened(half.host()) : y.host();
  }

  Case c;

 private:
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
int depth_of(int d_head) {
  int least = 256;
  for (const AttentionShape& shape : kAttentionShapes)
    if (shape.depth >= d_head) least = std::min(least, shape.depth);
  return least;
}

}  // namespace

TEST_CASE("attention on bf16 is within a rounding of its weights of doubles in every shape of blocks") {
  counts = {};
  for (const AttentionShape& shape : kAttentionShapes) {
    int n_run = 0;
    for (const Case& c : kCases) {
      if (depth_of(c.d_head) != shape.depth) continue;
      const Trial trial(c);
      const std::vector<double> expected = trial.expected();
      INFO(shape.kernel, ": ", c.n_query, " queries, heads of ", c.d_head);
      const auto how = [&](const AttentionJob& job) { return attention_bf16(shape, job); };
      in_every_schedule([&] {
        const auto halves = [](const std::vector<float>& of) { return bf16_rows(of, 1, 1); };
        CHECK(error(trial.run<std::uint16_t>(how, false, halves), expected) < 4e-3);
        if (schedule.seed == 0) CHECK(error(trial.run<std::uint16_t>(how, true, halves), expected) < 8e-3);
      });
      ++n_run;
    }
    CHECK(n_run > 0);
  }
  CHECK(counts.bank_conflicts == 0);
}

TEST_CASE("attention on bf16 in clusters is what another kernel makes of the shares, to the bit") {
  if (!is_hopper()) {
    MESSAGE("skipped: no device of compute capability 9.0");
    return;
  }
  counts = {};
  for (const AttentionShape& shape : kAttentionShapes) {
    int n_run = 0;
    for (const Case& c : kClusterCases) {
      if (depth_of(c.d_head) != shape.depth || !shape.fits_cluster(c.n_split)) continue;
      const Trial trial(c);
      INFO(shape.kernel, ": ", c.n_query, " queries, heads of ", c.d_head, ", ", c.n_split, " shares");
      const auto run = [&](bool y_is_bf16, bool in_cluster) {
        const auto how = [&](const AttentionJob& job) { return attention_bf16(shape, job); };
        const auto halves = [](const std::vector<float>& of) { return bf16_rows(of, 1, 1); };
        return trial.run<std::uint16_t>(how, y_is_bf16, halves, in_cluster);
      };
      const std::vector<float> wide = run(false, false), narrow = run(true, false);
      CHECK(error(wide, trial.expected()) < 4e-3);
      in_two_schedules(static_cast<std::size_t>((&c - kClusterCases) + (&shape - kAttentionShapes)), [&] {
        CHECK(run(false, true) == wide);
        CHECK(run(true, true) == narrow);
      });
      ++n_run;
    }
    CHECK((n_run > 0) == (shape.in_cluster != nullptr));
  }
  CHECK(counts.bank_conflicts == 0);
}

TEST_CASE("blocks of attention fit the shared memory of every device") {
  for (const AttentionShape& shape : kAttentionShapes) CHECK(shape.shared() <= static_cast<int>(kMaxShared));
}

TEST_CASE("attention in float32 is within 2e-6 of doubles") {
  for (const Case& c : kCases) {
    const Trial trial(c);
    INFO(c.n_query, " queries, heads of ", c.d_head);
    in_every_schedule([&] {
      const auto same = [](const std::vector<float>& of) { return of; };
      CHECK(error(trial.run<float>(attention_f32, false, same), trial.expected()) < 2e-6);
    });
  }
}

}  // namespace attention_test
