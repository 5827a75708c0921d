// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

/// Attentions of every size, what a kernel answers, and how far that is from the definition.
#include <doctest/doctest.h>

#include <cmath>
#include <functional>
#include <limits>
#include <map>
#include <memory>
#include <string_view>
#include <utility>
#include <vector>

#include "base/bf16.h"
#include "kernels/attention_kernel.h"
#include "support/executor.h"
#include "support/graph_runner.h"

namespace vla::test {

using kernels::AttentionJob;
using kernels::AttentionKernel;

/// What a mask holds for a key that is not seen.
inline constexpr float kHidden = -std::numeric_limits<float>::infinity();

struct AttentionShape {
  std::int64_t d_head, n_head, n_head_kv, n_query, n_key, n_batch;
};

/// One of everything that blocks, panels, chunks and groups have edges at.
inline constexpr AttentionShape kShapes[] = {{64, 2, 2, 70, 130, 2}, {64, 15, 5, 50, 227, 1}, {16, 6, 2, 5, 17, 1},
                                             {72, 2, 1, 25, 129, 1}, {80, 3, 3, 24, 128, 1},  {256, 4, 1, 7, 33, 1},
                                             {17, 1, 1, 1, 1, 3},    {1, 2, 2, 3, 300, 1},    {33, 4, 2, 1, 257, 1},
                                             {96, 1, 1, 49, 16, 1},  {8, 3, 3, 13, 31, 2}};

/// Values, and a mask that may be empty. Rows lie `gap` floats apart.
struct Case {
  AttentionShape shape;
  std::vector<float> q, k, v, mask;
  std::int64_t gap = 0;
  kernels::RoundedLayout layout = kernels::RoundedLayout::none;
  std::vector<std::uint16_t> rounded_q, rounded_k, rounded_v;

  Case(const AttentionShape& s, float range, std::int64_t row_gap) : shape(s), gap(row_gap) {
    const auto count = [&](std::int64_t n_head, std::int64_t n_token) {
      return static_cast<std::size_t>((s.d_head + gap) * n_head * n_token * s.n_batch);
    };
    q = ramp(count(s.n_head, s.n_query), range);
    k = ramp(count(s.n_head_kv, s.n_key), 2);
    v = ramp(count(s.n_head_kv, s.n_key), 3);
  }

  template <class Value>
  void set_mask(Value value) {
    for (std::int64_t i = 0; i < shape.n_query; ++i)
      for (std::int64_t j = 0; j < shape.n_key; ++j) mask.push_back(value(i, j));
  }

  /// Queries, keys and values come as products that round leave them.
  void round(kernels::RoundedLayout to) {
    layout = to;
    rounded_q = rounded(q, shape.n_head), rounded_k = rounded(k, shape.n_head_kv);
    rounded_v = rounded(v, shape.n_head_kv);
  }
  std::vector<std::uint16_t> rounded(const std::vector<float>& x, std::int64_t n_head) const {
    const std::int64_t d = (shape.d_head + gap) * n_head, n = static_cast<std::int64_t>(x.size());
    std::vector<std::uint16_t> result(static_cast<std::size_t>(kernels::rounded_count(layout, n / d, d)), 0xffff);
    for (std::int64_t i = 0; i < n; ++i) {
      const std::int64_t place = kernels::rounded_place(layout, i / d, i % d, d);
      result[static_cast<std::size_t>(place)] = to_bf16(x[static_cast<std::size_t>(i)]);
    }
    return result;
  }

  kernels::HeadRows rows(const std::vector<float>& x, const std::vector<std::uint16_t>& rounded_x, std::int64_t n_head,
                         std::int64_t n_token) const {
    const std::int64_t row = shape.d_head + gap;
    const auto* data = layout == kernels::RoundedLayout::none ? reinterpret_cast<const std::byte*>(x.data())
                                                              : reinterpret_cast<const std::byte*>(rounded_x.data());
    return {data, 0, row, row * n_head, row * n_head * n_token, layout, row * n_head};
  }
  kernels::HeadRows queries() const { return rows(q, rounded_q, shape.n_head, shape.n_query); }
  kernels::HeadRows keys() const { return rows(k, rounded_k, shape.n_head_kv, shape.n_key); }
  kernels::HeadRows values() const { return rows(v, rounded_v, shape.n_head_kv, shape.n_key); }
  float scale() const { return 1 / std::sqrt(static_cast<float>(shape.d_head)); }
};

/// What is done to queries and keys on the way.
struct Preparation {
  kernels::RowPrep q, k;
};

/// What the kernel answers with `n_thread` workers, keys and values in segments of `n_key`, which add up to all. Memory
/// holds NaNs before it is written. The answer goes to `rounded` instead, as the kernel rounds it, if that is given.
inline std::vector<float> run(const AttentionKernel& kernel, const Case& c, int n_thread,
                              std::vector<std::int64_t> n_key = {}, const Preparation& prep = {},
                              std::vector<std::uint16_t>* rounded = nullptr) {
  const AttentionShape& s = c.shape;
  if (n_key.empty()) n_key = {s.n_key};
  const float nan = std::numeric_limits<float>::quiet_NaN();
  std::vector<float> out(static_cast<std::size_t>(s.d_head * s.n_head * s.n_query * s.n_batch), nan);
  AttentionJob job = {};
  job.d_head = s.d_head, job.n_head = s.n_head, job.n_head_kv = s.n_head_kv;
  job.n_query = s.n_query, job.n_key = s.n_key, job.n_batch = s.n_batch;
  job.scale = c.scale(), job.q = c.queries(), job.prep = prep.q;
  job.mask = c.mask.empty() ? nullptr : c.mask.data();
  job.out = reinterpret_cast<std::byte*>(out.data());
  if (rounded != nullptr) {
    job.out_layout = kernel.rounded;
    const std::int64_t n = kernels::rounded_count(kernel.rounded, s.n_query * s.n_batch, s.n_head * s.d_head);
    rounded->assign(static_cast<std::size_t>(n), 0xffff);
    job.out = reinterpret_cast<std::byte*>(rounded->data());
  }
  std::vector<std::vector<float>> packed;  // a vector keeps its numbers where they are when it moves
  std::int64_t first = 0;
  for (const std::int64_t n : n_key) {
    kernels::PackJob pack = {s.d_head, s.n_head_kv, n, s.n_batch, c.keys(), c.values(), prep.k, nullptr};
    pack.k.first += first * pack.k.token, pack.v.first += first * pack.v.token;
    if (pack.prep.table != nullptr) pack.prep.table += first * s.d_head;
    packed.emplace_back(kernel.packed_size(pack) / sizeof(float) + 16, nan);
    void* place = packed.back().data();
    std::size_t room = packed.back().size() * sizeof(float);
    pack.packed = static_cast<std::byte*>(std::align(64, kernel.packed_size(pack), place, room));
    run_items(kernel.n_pack(pack), n_thread, [&](std::int64_t item, kernels::Worker&) { kernel.pack(pack, item); });
    job.segment[job.n_segment++] = {pack.packed, n, first};
    first += n;
  }
  REQUIRE(first == s.n_key);
  run_items(kernel.cut(job, n_thread), n_thread, [&](std::int64_t item, kernels::Worker&) { kernel.run(job, item); });
  return out;
}

/// The definition for one query and head, in double.
inline std::vector<double> exact_row(const Case& c, std::int64_t head, std::int64_t query, std::int64_t batch) {
  const AttentionShape& s = c.shape;
  const std::int64_t head_kv = head / (s.n_head / s.n_head_kv);
  const kernels::HeadRows keys = c.keys(), values = c.values();
  const float* q = c.queries().at(head, query, batch);
  std::vector<double> score, mixed(static_cast<std::size_t>(s.d_head));
  double most = kHidden, sum = 0;
  for (std::int64_t j = 0; j < s.n_key; ++j) {
    const float* k = keys.at(head_kv, j, batch);
    double dot = 0;
    for (std::int64_t i = 0; i < s.d_head; ++i) dot += double{q[i]} * k[i];
    score.push_back(dot / std::sqrt(static_cast<double>(s.d_head)) +
                    (c.mask.empty() ? 0 : c.mask[static_cast<std::size_t>(query * s.n_key + j)]));
    most = std::max(most, score.back());
  }
  for (double& value : score) sum += value = std::exp(value - most);
  for (std::int64_t j = 0; j < s.n_key; ++j) {
    const float* v = values.at(head_kv, j, batch);
    for (std::size_t i = 0; i < mixed.size(); ++i) mixed[i] += score[static_cast<std::size_t>(j)] / sum * v[i];
  }
  return mixed;
}

/// The definition for all of them. It takes longer than the kernels that it judges, so each case is computed once.
inline const std::vector<double>& exact(const Case& c) {
  const AttentionShape& s = c.shape;
  std::vector<std::size_t> key = {static_cast<std::size_t>(c.gap)};
  for (const std::int64_t n : {s.d_head, s.n_head, s.n_head_kv, s.n_query, s.n_key, s.n_batch})
    key.push_back(static_cast<std::size_t>(n));
  for (const auto* numbers : {&c.q, &c.k, &c.v, &c.mask})
    key.push_back(std::hash<std::string_view>()(
        {reinterpret_cast<const char*>(numbers->data()), numbers->size() * sizeof(float)}));
  static std::map<std::vector<std::size_t>, std::vector<double>> known;
  const auto [place, is_new] = known.try_emplace(key);
  if (!is_new) return place->second;
  for (std::int64_t batch = 0; batch < s.n_batch; ++batch)
    for (std::int64_t query = 0; query < s.n_query; ++query)
      for (std::int64_t head = 0; head < s.n_head; ++head)
        for (const double x : exact_row(c, head, query, batch)) place->second.push_back(x);
  return place->second;
}

inline double worst_error(const Case& c, const std::vector<float>& got) {
  const std::vector<double>& expected = exact(c);
  REQUIRE(expected.size() == got.size());
  double worst = 0;
  for (std::size_t i = 0; i < got.size(); ++i) {
    const double error = std::abs(got[i] - expected[i]);
    worst = error <= worst ? worst : error;  // a NaN is worse than anything
  }
  return worst;
}

/// Panels, chunks and vectors that end everywhere.
template <class Check>
void for_each_end(Check check) {
  for (std::int64_t d_head : {8, 24, 40, 64, 72, 80, 96, 255, 256})
    for (std::int64_t n_key : {1, 2, 15, 31, 32, 33, 100, 129, 257}) {
      CAPTURE(d_head);
      CAPTURE(n_key);
      check(Case({d_head, 2, 1, 3, n_key, 1}, 1, d_head % 5));
    }
  for (std::int64_t n_key = 1; n_key <= 300; n_key += 3) {
    CAPTURE(n_key);
    check(Case({40, 1, 1, 2, n_key, 1}, 1, 0));
  }
}

/// Every chunk of keys brings greater scores than those before it: by a little, which leaves weights above one, or by
/// so much that what was mixed before has to become small.
inline Case rising(double step) {
  Case c({32, 1, 1, 40, 800, 1}, 2, 0);
  for (std::size_t i = 0; i < c.q.size(); ++i) c.q[i] = i % 32 == 0 ? 4.0f : 0.0f;
  for (std::size_t i = 0; i < c.k.size(); i += 32)
    c.k[i] = static_cast<float>(step * static_cast<double>(i / 32 / 100)) + c.k[i] / 8;
  return c;
}

/// Keys of which the last stands for `n` equal ones, and the same with all of them.
struct Repeated {
  Case one, all;
};
inline Repeated repeated(const AttentionShape& shape, int n) {
  AttentionShape longer = shape;
  longer.n_key += n - 1;
  Repeated r = {Case(shape, 2, 0), Case(longer, 2, 0)};
  r.one.set_mask(
      [&](std::int64_t, std::int64_t j) { return j + 1 == shape.n_key ? std::log(static_cast<float>(n)) : 0.0f; });
  r.all.q = r.one.q;
  for (auto [one, all] : {std::pair(&r.one.k, &r.all.k), std::pair(&r.one.v, &r.all.v)}) {
    const auto token = static_cast<std::size_t>(shape.d_head * shape.n_head_kv);
    for (std::size_t i = 0; i < all->size(); ++i)
      (*all)[i] = (*one)[i < one->size() ? i : one->size() - token + i % token];
  }
  return r;
}
/// Vision towers, and the head of an action: a width and a number of keys that nothing divides.
inline constexpr AttentionShape kRepeatedShapes[] = {
    {112, 8, 8, 50, 1025, 1}, {112, 2, 1, 3, 2, 1}, {64, 2, 1, 7, 129, 1}};

inline void check_attention_of_not_finite(const AttentionKernel& attention) {
  Case unseen(kShapes[2], 1, 0);
  unseen.set_mask([](std::int64_t i, std::int64_t) { return i == 0 ? kHidden : 0.0f; });
  const std::vector<float> out = run(attention, unseen, 1);
  CHECK(std::isnan(out.front()));
  CHECK(std::isfinite(out.back()));
  for (float bad : {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()}) {
    Case broken(kShapes[2], 1, 0);
    broken.k[3] = bad;
    CHECK_FALSE(std::isfinite(run(attention, broken, 1).front()));
    broken = Case(kShapes[2], 1, 0);
    broken.v[0] = bad;
    CHECK_FALSE(std::isfinite(run(attention, broken, 1).front()));
  }
}

}  // namespace vla::test
