// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/attention.h"
#include "nn/tokens.h"
#include "support/attention_case.h"
#include "support/kernel_rows.h"

namespace attention_test {

using namespace vla;
using namespace vla::test;
using kernels::CpuKernels;

namespace {

/// The plain operations of ggml on the same numbers.
std::vector<float> run_plain(const Case& c) {
  const AttentionShape& s = c.shape;
  return test::run_graph(
      [&](Graph& g) {
        const auto add = [&](const std::vector<float>& x, std::int64_t n_head, std::int64_t n_token) {
          const Tensor all = constant(g, x, {s.d_head + c.gap, n_head, n_token, s.n_batch});
          return slice(g, all, 0, 0, static_cast<int>(s.d_head));
        };
        const Tensor mask = c.mask.empty() ? Tensor() : constant(g, c.mask, {s.n_key, s.n_query});
        return attention(g, add(c.q, s.n_head, s.n_query),
                         {{add(c.k, s.n_head_kv, s.n_key), add(c.v, s.n_head_kv, s.n_key)}}, mask);
      },
      "ggml");
}

/// Both sides round sums of the same length in another order. The second part is one rounding of a score of 8, which
/// changes its weight by 5e-7 of itself.
void check_against_plain(const CpuKernels& kernels, const Case& c, int n_thread) {
  const AttentionShape& s = c.shape;
  CAPTURE(s.d_head);
  CAPTURE(s.n_query);
  CAPTURE(s.n_key);
  CAPTURE(n_thread);
  CHECK(worst_error(c, run(kernels.attention, c, n_thread)) <= 4 * worst_error(c, run_plain(c)) + 5e-7);
}

void check_shapes(const CpuKernels& kernels) {
  for (const AttentionShape& shape : kShapes)
    for (float range : {1.0f, 30.0f}) check_against_plain(kernels, Case(shape, range, shape.n_key % 3), 3);
}

void check_masks(const CpuKernels& kernels) {
  for (const AttentionShape& shape : {kShapes[0], kShapes[1], kShapes[3]}) {
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

void check_repeated(const CpuKernels& kernels) {
  for (const AttentionShape& shape : kRepeatedShapes)
    for (int n : {2, 218, 512}) {
      CAPTURE(shape.n_key);
      CAPTURE(n);
      const Repeated r = repeated(shape, n);
      CHECK(worst_error(r.all, run(kernels.attention, r.one, 2)) <= 1e-5);
    }
}

void check_ends(const CpuKernels& kernels) {
  for_each_end([&](const Case& c) { CHECK(worst_error(c, run(kernels.attention, c, 1)) <= 5e-6); });
}

void check_rising(const CpuKernels& kernels) {
  for (double step : {0.5, 3.0, 40.0})
    CHECK(worst_error(rising(step), run(kernels.attention, rising(step), 1)) <= 5e-6);
}

void check_threads(const CpuKernels& kernels) {
  for (const AttentionShape& shape : {kShapes[1], kShapes[6]}) {
    const Case c(shape, 1, 0);
    for (int n_thread : {1, 2, 7, 64}) CHECK(worst_error(c, run(kernels.attention, c, n_thread)) <= 2e-6);
  }
}

/// Keys and values that are packed apart, as those of a prefix and of the tokens behind it are.
void check_segments(const CpuKernels& kernels) {
  for (const AttentionShape& shape : {kShapes[0], kShapes[1], kShapes[10]}) {
    Case whole(shape, 2, 1), masked(shape, 2, 1);
    masked.set_mask([&](std::int64_t i, std::int64_t j) {
      return j % 97 < 60 || (i + j) % 3 == 0 ? static_cast<float>(j % 5) / 4 : kHidden;
    });
    const std::int64_t n = shape.n_key;
    for (const Case* c : {&whole, &masked}) {
      const double bound = 4 * worst_error(*c, run_plain(*c)) + 5e-7;
      for (const std::vector<std::int64_t>& n_key :
           {std::vector<std::int64_t>{1, n - 1}, {n - 1, 1}, {n / 2, n - n / 2}, {5, 1, 1, n - 9, 2}})
        CHECK(worst_error(*c, run(kernels.attention, *c, 2, n_key)) <= bound);
    }
  }
}

/// Norm and rotation of heads while rows are copied, against the same done beforehand.
void check_prepared(const CpuKernels& kernels) {
  for (const AttentionShape& shape : {kShapes[1], kShapes[4], kShapes[10]}) {
    const Case c(shape, 2, 0);
    const auto d = static_cast<std::size_t>(shape.d_head);
    const std::vector<float> weight = ramp(d, 2), table = ramp(d * 300, 1);
    kernels::RowPrep prep = {kernels.rms_norm, weight.data(), 1e-5f, kernels.rotate_half, table.data()};
    Case done = c;
    const auto prepare = [&](std::vector<float>& x, std::int64_t n_head, std::int64_t n_token) {
      for (std::size_t row = 0; row < x.size() / d; ++row) {
        const std::int64_t token = static_cast<std::int64_t>(row) / n_head % n_token;
        prep(&x[row * d], token, shape.d_head, &x[row * d]);
      }
    };
    prepare(done.q, shape.n_head, shape.n_query);
    prepare(done.k, shape.n_head_kv, shape.n_key);
    CHECK(run(kernels.attention, c, 2, {}, {prep, prep}) == run(kernels.attention, done, 2));
    CHECK(run(kernels.attention, c, 2, {3, shape.n_key - 3}, {prep, prep}) ==
          run(kernels.attention, done, 2, {3, shape.n_key - 3}));
  }
}

void check_not_finite(const CpuKernels& kernels) { check_attention_of_not_finite(kernels.attention); }

}  // namespace

VLA_KERNEL_TEST("attention of awkward shapes and strides errs at most four times as much as ggml's products",
                check_shapes)
VLA_KERNEL_TEST("attention is exact under causal, speckled, late and additive masks", check_masks)
VLA_KERNEL_TEST("a key with the logarithm of n in the mask is as n equal keys", check_repeated)
VLA_KERNEL_TEST("attention is exact however many threads share it", check_threads)
VLA_KERNEL_TEST("attention is exact whatever the width of a head and the number of keys", check_ends)
VLA_KERNEL_TEST("attention is exact where each chunk of keys brings greater scores", check_rising)
VLA_KERNEL_TEST("attention over keys in several segments is as over all of them in one", check_segments)
VLA_KERNEL_TEST("norm and rotation of heads on the way are as before", check_prepared)
VLA_KERNEL_TEST("a query that sees nothing, and what is not finite, does not become an answer", check_not_finite)

TEST_CASE("ggml: a key with the logarithm of n in the mask is as n equal keys") {
  for (const AttentionShape& shape : kRepeatedShapes)
    for (int n : {2, 218, 512}) {
      const Repeated r = repeated(shape, n);
      CHECK(worst_error(r.all, run_plain(r.one)) <= 1e-5);
    }
}

}  // namespace attention_test
