// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/attention.h"

#include "nn/attention.h"
#include "support/attention_case.h"
#include "support/kernel_rows.h"

using namespace vla;
using namespace vla::test;
using kernels::CpuKernels;

namespace {

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

void check_repeated(const CpuKernels& kernels) {
  for (const Shape& shape : kRepeatedShapes)
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
  for (const Shape& shape : {kShapes[1], kShapes[6]}) {
    const Case c(shape, 1, 0);
    for (int n_thread : {1, 2, 7, 64}) CHECK(worst_error(c, run(kernels.attention, c, n_thread)) <= 2e-6);
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
VLA_KERNEL_TEST("a query that sees nothing, and what is not finite, does not become an answer", check_not_finite)

TEST_CASE("ggml: a key with the logarithm of n in the mask is as n equal keys") {
  for (const Shape& shape : kRepeatedShapes)
    for (int n : {2, 218, 512}) {
      const Repeated r = repeated(shape, n);
      CHECK(worst_error(r.all, run_plain(r.one)) <= 1e-5);
    }
}
