// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/attention.h"

#include <cmath>
#include <limits>

#include "kernels/attention_products.h"
#include "nn/attention.h"
#include "support/graph_runner.h"
#include "support/kernel_rows.h"

using namespace vla;
using kernels::AttentionJob;
using kernels::AttentionKernel;
using kernels::CpuKernels;
using test::ramp;

namespace {

constexpr float kHidden = -std::numeric_limits<float>::infinity();

struct Shape {
  std::int64_t d_head, n_head, n_head_kv, n_query, n_key, n_batch;
};

/// One of everything that blocks, panels, chunks and groups have edges at.
constexpr Shape kShapes[] = {{64, 2, 2, 70, 130, 2}, {64, 15, 5, 50, 227, 1}, {16, 6, 2, 5, 17, 1},
                             {72, 2, 1, 25, 129, 1}, {80, 3, 3, 24, 128, 1},  {256, 4, 1, 7, 33, 1},
                             {17, 1, 1, 1, 1, 3},    {1, 2, 2, 3, 300, 1},    {33, 4, 2, 1, 257, 1},
                             {96, 1, 1, 49, 16, 1},  {8, 3, 3, 13, 31, 2}};

/// Values, and a mask that may be empty. Rows lie `gap` floats apart.
struct Case {
  Shape shape;
  std::vector<float> q, k, v, mask;
  std::int64_t gap = 0;

  Case(const Shape& s, float range, std::int64_t row_gap) : shape(s), gap(row_gap) {
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

  AttentionJob::Rows rows(const std::vector<float>& x, std::int64_t n_head, std::int64_t n_token) const {
    const std::int64_t row = shape.d_head + gap;
    return {x.data(), row, row * n_head, row * n_head * n_token};
  }
  AttentionJob job() const {
    const Shape& s = shape;
    return {.d_head = s.d_head,
            .n_head = s.n_head,
            .n_head_kv = s.n_head_kv,
            .n_query = s.n_query,
            .n_key = s.n_key,
            .n_batch = s.n_batch,
            .scale = 1 / std::sqrt(static_cast<float>(s.d_head)),
            .q = rows(q, s.n_head, s.n_query),
            .k = rows(k, s.n_head_kv, s.n_key),
            .v = rows(v, s.n_head_kv, s.n_key),
            .mask = mask.empty() ? nullptr : mask.data(),
            .packed = nullptr,
            .out = nullptr};
  }
};

/// What the kernel answers when `n_thread` threads share the work. Memory holds NaNs before it is written.
std::vector<float> run(const AttentionKernel& kernel, const Case& c, int n_thread) {
  AttentionJob job = c.job();
  const float nan = std::numeric_limits<float>::quiet_NaN();
  std::vector<float> packed(static_cast<std::size_t>(kernel.packed_size(job)), nan);
  std::vector<float> out(static_cast<std::size_t>(job.d_head * job.n_head * job.n_query * job.n_batch), nan);
  job.packed = packed.data();
  job.out = out.data();
  for (int i = 0; i < n_thread; ++i) kernel.pack(job, i, n_thread);
  for (int i = 0; i < n_thread; ++i) kernel.run(job, i, n_thread);
  return out;
}

/// The plain operations of ggml on the same numbers.
std::vector<float> run_plain(const Case& c) {
  const Shape& s = c.shape;
  return test::run_graph(
      [&](Graph& g) {
        const auto add = [&](const std::vector<float>& x, std::int64_t n_head, std::int64_t n_token) {
          const Tensor all = g.store().add_constant(x, {s.d_head + c.gap, n_head, n_token, s.n_batch});
          const ggml_tensor* t = all.node();
          return Tensor(ggml_view_4d(g.context(), all.node(), s.d_head, n_head, n_token, s.n_batch, t->nb[1], t->nb[2],
                                     t->nb[3], 0));
        };
        const Tensor mask = c.mask.empty() ? Tensor() : g.store().add_constant(c.mask, {s.n_key, s.n_query});
        return attention(g, add(c.q, s.n_head, s.n_query), add(c.k, s.n_head_kv, s.n_key),
                         add(c.v, s.n_head_kv, s.n_key), mask);
      },
      "ggml");
}

/// The definition for one query and head, in double.
std::vector<double> exact_row(const Case& c, std::int64_t head, std::int64_t query, std::int64_t batch) {
  const AttentionJob job = c.job();
  const std::int64_t head_kv = head / (job.n_head / job.n_head_kv);
  std::vector<double> score, mixed(static_cast<std::size_t>(job.d_head));
  double most = kHidden, sum = 0;
  for (std::int64_t j = 0; j < job.n_key; ++j) {
    double dot = 0;
    for (std::int64_t i = 0; i < job.d_head; ++i)
      dot += double{job.q.at(head, query, batch)[i]} * job.k.at(head_kv, j, batch)[i];
    score.push_back(dot / std::sqrt(static_cast<double>(job.d_head)) +
                    (job.mask != nullptr ? job.mask[query * job.n_key + j] : 0));
    most = std::max(most, score.back());
  }
  for (double& value : score) sum += value = std::exp(value - most);
  for (std::int64_t j = 0; j < job.n_key; ++j)
    for (std::size_t i = 0; i < mixed.size(); ++i)
      mixed[i] += score[static_cast<std::size_t>(j)] / sum * job.v.at(head_kv, j, batch)[i];
  return mixed;
}

double worst_error(const Case& c, const std::vector<float>& got) {
  double worst = 0;
  std::size_t at = 0;
  for (std::int64_t batch = 0; batch < c.shape.n_batch; ++batch)
    for (std::int64_t query = 0; query < c.shape.n_query; ++query)
      for (std::int64_t head = 0; head < c.shape.n_head; ++head)
        for (double expected : exact_row(c, head, query, batch)) {
          const double error = std::abs(got[at++] - expected);
          worst = error <= worst ? worst : error;  // a NaN is worse than anything
        }
  REQUIRE(at == got.size());
  return worst;
}

/// Both sides round sums of the same length in another order. The second part is one rounding of a score of 8, which
/// changes its weight by 5e-7 of itself.
void check_against_plain(const CpuKernels& kernels, const Case& c, int n_thread) {
  const Shape& s = c.shape;
  CAPTURE(s.d_head);
  CAPTURE(s.n_query);
  CAPTURE(s.n_key);
  CAPTURE(n_thread);
  CHECK(worst_error(c, run(kernels.attention, c, n_thread)) <= 4 * worst_error(c, run_plain(c)) + 5e-7);
}

void check_shapes(const CpuKernels& kernels) {
  for (const Shape& shape : kShapes)
    for (float range : {1.0f, 30.0f}) check_against_plain(kernels, Case(shape, range, shape.n_key % 3), 3);
}

void check_masks(const CpuKernels& kernels) {
  for (const Shape& shape : {kShapes[0], kShapes[1], kShapes[3]}) {
    Case causal(shape, 2, 0), speckled(shape, 2, 0), late(shape, 2, 0), biased(shape, 2, 0),
        nowhere_hidden(shape, 2, 0);
    causal.set_mask([&](std::int64_t i, std::int64_t j) { return j <= i + 1 ? 0.0f : kHidden; });
    speckled.set_mask([&](std::int64_t i, std::int64_t j) { return (7 * j + 3 * i) % 5 == 0 ? 0.0f : kHidden; });
    // Some rows of a block see nothing of the first chunk of keys, others do.
    late.set_mask([&](std::int64_t i, std::int64_t j) { return i % 2 == 0 || j + 1 == shape.n_key ? 0.0f : kHidden; });
    biased.set_mask([&](std::int64_t i, std::int64_t j) { return static_cast<float>(i - j) / 16; });
    nowhere_hidden.set_mask([](std::int64_t, std::int64_t) { return 0.0f; });
    for (const Case& c : {causal, speckled, late, biased, nowhere_hidden}) check_against_plain(kernels, c, 2);
  }
}

/// Numbers as bf16 holds them, so that nothing but the weights is rounded on the way.
std::vector<float> as_bf16(std::vector<float> values) {
  for (float& value : values) value = std::bit_cast<float>(std::bit_cast<std::uint32_t>(value) & 0xffff0000U);
  return values;
}

/// A weight rounded to bf16 is off by 2^-9 of itself, and weights of one row have the sum 1.
constexpr double kPairBound = 3.0 / 512 + 1e-5;  // 3 is the greatest value

void check_pairs(const AttentionKernel& kernel) {
  for (const Shape& shape : kShapes) {
    CAPTURE(shape.d_head);
    CAPTURE(shape.n_key);
    for (bool masked : {false, true}) {
      Case c(shape, 2, shape.n_key % 3);
      if (masked) c.set_mask([](std::int64_t i, std::int64_t j) { return j <= i || j % 7 == 0 ? 0.0f : kHidden; });
      c.q = as_bf16(c.q), c.k = as_bf16(c.k), c.v = as_bf16(c.v);
      CHECK(worst_error(c, run(kernel, c, 2)) <= kPairBound);
    }
  }
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

void check_ends(const CpuKernels& kernels) {
  for_each_end([&](const Case& c) { CHECK(worst_error(c, run(kernels.attention, c, 1)) <= 5e-6); });
}

/// Every chunk of keys brings greater scores than those before it: by a little, which leaves weights above one, or by
/// so much that what was mixed before has to become small.
Case rising(double step) {
  Case c({32, 1, 1, 40, 800, 1}, 2, 0);
  for (std::size_t i = 0; i < c.q.size(); ++i) c.q[i] = i % 32 == 0 ? 4.0f : 0.0f;
  for (std::size_t i = 0; i < c.k.size(); i += 32)
    c.k[i] = static_cast<float>(step * static_cast<double>(i / 32 / 100)) + c.k[i] / 8;
  return c;
}

void check_rising(const CpuKernels& kernels) {
  for (double step : {0.5, 3.0, 40.0})
    CHECK(worst_error(rising(step), run(kernels.attention, rising(step), 1)) <= 5e-6);
}

void check_threads(const CpuKernels& kernels) {
  for (const Shape& shape : {kShapes[1], kShapes[6]}) {
    const Case c(shape, 1, 0);
    for (int n_thread : {1, 2, 7, 64}) CHECK(worst_error(c, run(kernels.attention, c, n_thread)) <= 2e-6);
  }
}

void check_pair_ends(const AttentionKernel& kernel) {
  for_each_end([&](Case c) {
    c.q = as_bf16(c.q), c.k = as_bf16(c.k), c.v = as_bf16(c.v);
    CHECK(worst_error(c, run(kernel, c, 1)) <= kPairBound);
  });
}

/// Chunks of keys that nobody sees, that some rows see nothing of, and that begin and end anywhere.
void check_pair_masks(const AttentionKernel& kernel) {
  for (std::int64_t n_key : {500, 900, 1100})
    for (std::int64_t n_query : {1, 33}) {
      CAPTURE(n_key);
      CAPTURE(n_query);
      Case c({32, 2, 1, n_query, n_key, 1}, 2, 0);
      c.q = as_bf16(c.q), c.k = as_bf16(c.k), c.v = as_bf16(c.v);
      CHECK(worst_error(c, run(kernel, c, 1)) <= kPairBound);
      c.set_mask([&](std::int64_t i, std::int64_t j) {
        return j / 256 == 1 || (j / 256 == 2 && i % 3 == 0) || (j + i) % 7 == 0 ? kHidden : 0.0f;
      });
      CHECK(worst_error(c, run(kernel, c, 1)) <= kPairBound);
    }
}

/// Values that single out one key each: the answers are the weights themselves.
void check_pair_weights(const AttentionKernel& kernel) {
  Case c({32, 1, 1, 1, 32, 1}, 1, 0);
  for (std::size_t i = 0; i < c.q.size(); ++i) c.q[i] = i == 0 ? 1.0f : 0.0f;
  for (std::size_t i = 0; i < c.k.size(); ++i) {
    c.k[i] = i % 32 == 0 ? -15.5f * static_cast<float>(i / 32) : 0.0f;
    c.v[i] = i % 33 == 0 ? 1.0f : 0.0f;
  }
  c.k = as_bf16(c.k);
  const std::vector<float> out = run(kernel, c, 1);
  const std::vector<double> exact = exact_row(c, 0, 0, 0);
  for (std::size_t i = 0; i < out.size(); ++i) CHECK(std::abs(out[i] / exact[i] - 1) <= 1.0 / 256);
  for (double step : {0.5, 3.0, 40.0}) {
    Case rises = rising(step);
    rises.k = as_bf16(rises.k), rises.v = as_bf16(rises.v);
    CHECK(worst_error(rises, run(kernel, rises, 1)) <= kPairBound);
  }
}

void check_not_finite(const AttentionKernel& attention) {
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

void check_not_finite(const CpuKernels& kernels) { check_not_finite(kernels.attention); }
void check_pairs_not_finite(const AttentionKernel& kernel) { check_not_finite(kernel); }

}  // namespace

/// A test of kernels that round to bf16: the portable instance, the emulated one, and the machine's.
#define VLA_PAIR_TEST(sentence, check)                                               \
  TEST_CASE("portable amx: " sentence) { check(kernels::emulated_amx_attention()); } \
  VLA_EMULATED_TEST("amx", sentence, check(kernels::kEmulatedAttentionAmx))          \
  TEST_CASE("amx: " sentence* doctest::skip(test::lacks(Isa::amx))) {                \
    check(kernels::cpu_kernels(Isa::amx)->attention);                                \
  }

VLA_KERNEL_TEST("attention of awkward shapes and strides errs at most four times as much as ggml's products",
                check_shapes)
VLA_KERNEL_TEST("attention is exact under causal, speckled, late and additive masks", check_masks)
VLA_KERNEL_TEST("attention is exact however many threads share it", check_threads)
VLA_KERNEL_TEST("attention is exact whatever the width of a head and the number of keys", check_ends)
VLA_KERNEL_TEST("attention is exact where each chunk of keys brings greater scores", check_rising)
VLA_KERNEL_TEST("a query that sees nothing, and what is not finite, does not become an answer", check_not_finite)

TEST_CASE("a weight for bf16 errs by 2^-18 of itself at most") {
  using V = kernels::Portable;
  double worst = 0;
  for (int i = -126 * 4096; i <= 10 * 4096; ++i) {
    const float x = static_cast<float>(i) / 4096;
    worst = std::max(worst, std::abs(kernels::exp2_for_bf16<V>(V::set(x))[0] / std::exp2(double{x}) - 1));
  }
  CHECK(worst <= std::ldexp(1.0, -18));
  CHECK(kernels::exp2_for_bf16<V>(V::set(-3))[0] == 0.125f);
  for (float far : {-200.0f, -3e38f, kHidden}) CHECK(kernels::exp2_for_bf16<V>(V::set(far))[0] == 0.0f);
  CHECK(std::isnan(kernels::exp2_for_bf16<V>(V::set(std::numeric_limits<float>::quiet_NaN()))[0]));
}

VLA_PAIR_TEST("attention errs by the rounding of its weights to bf16 alone", check_pairs)
VLA_PAIR_TEST("attention is right whatever the width of a head and the number of keys", check_pair_ends)
VLA_PAIR_TEST("attention keeps small weights, and greater scores make earlier ones smaller", check_pair_weights)
VLA_PAIR_TEST("attention skips what a mask hides, and chunks that it hides whole", check_pair_masks)
VLA_PAIR_TEST("a query that sees nothing, and what is not finite, does not become an answer", check_pairs_not_finite)
