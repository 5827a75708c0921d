// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Attention of numbers rounded to bf16, as AVX-512 BF16 and AMX's tiles multiply them.
#include "kernels/attention_products.h"

#include "base/bf16.h"
#include "kernels/portable/vec_portable.h"
#include "support/attention_case.h"
#include "support/kernel_rows.h"

namespace attention_pairs_test {

using namespace vla;
using namespace vla::test;

namespace {

/// Numbers as bf16 holds them, so that nothing but the weights is rounded on the way.
std::vector<float> as_bf16(std::vector<float> values) {
  for (float& value : values) value = std::bit_cast<float>(std::bit_cast<std::uint32_t>(value) & 0xffff0000U);
  return values;
}

/// A weight rounded to bf16 is off by 2^-9 of itself, and weights of one row have the sum 1.
constexpr double kPairBound = 3.0 / 512 + 1e-5;  // 3 is the greatest value

void check_pairs(const AttentionKernel& kernel) {
  for (const AttentionShape& shape : kShapes) {
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

void check_pair_repeated(const AttentionKernel& kernel) {
  for (const AttentionShape& shape : kRepeatedShapes)
    for (int n : {2, 218, 512}) {
      CAPTURE(shape.n_key);
      CAPTURE(n);
      Repeated r = repeated(shape, n);
      for (Case* c : {&r.one, &r.all}) c->q = as_bf16(c->q), c->k = as_bf16(c->k), c->v = as_bf16(c->v);
      CHECK(worst_error(r.all, run(kernel, r.one, 2)) <= kPairBound);
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
    for (std::int64_t n_query : {1, 33, 100}) {
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

/// A product that rounds what it reads finds the answer rounded, where it looks for it.
void check_pair_rounded(const AttentionKernel& kernel) {
  for (const AttentionShape& shape : {AttentionShape{64, 2, 1, 40, 50, 2}, AttentionShape{16, 4, 2, 37, 33, 1},
                                      AttentionShape{72, 4, 1, 33, 40, 2}, AttentionShape{48, 2, 2, 5, 64, 1}}) {
    CAPTURE(shape.d_head);
    const Case c(shape, 2, 0);
    std::vector<std::uint16_t> rounded;
    const std::vector<float> floats = run(kernel, c, 2);
    run(kernel, c, 2, {}, {}, &rounded);
    const std::int64_t d = shape.n_head * shape.d_head;
    int n_wrong = 0;
    for (std::int64_t i = 0; i < static_cast<std::int64_t>(floats.size()); ++i) {
      const std::int64_t place = kernels::rounded_place(kernel.rounded, i / d, i % d, d);
      n_wrong += rounded[static_cast<std::size_t>(place)] != to_bf16(floats[static_cast<std::size_t>(i)]);
    }
    CHECK(n_wrong == 0);
  }
}

/// It reads what products left rounded as it would round it itself.
void check_pair_operands(const AttentionKernel& kernel) {
  for (const AttentionShape& shape : kShapes)
    for (const std::vector<std::int64_t>& n_key : {std::vector<std::int64_t>{}, {1, shape.n_key - 1}}) {
      CAPTURE(shape.d_head);
      CAPTURE(shape.n_key);
      if (shape.n_key == 1 && !n_key.empty()) continue;
      Case c(shape, 2, shape.n_key % 3);
      const std::vector<float> expected = run(kernel, c, 2, n_key);
      c.round(kernel.rounded);
      CHECK(run(kernel, c, 2, n_key) == expected);
    }
}

}  // namespace

/// A test of kernels that round to bf16: the emulated ones, and the machine's.
#define VLA_PAIR_TEST(sentence, check)                                                       \
  VLA_EMULATED_TEST("avx512_bf16", sentence, check(kernels::kEmulatedAttentionAvx512Bf16))   \
  TEST_CASE("avx512_bf16: " sentence* doctest::skip(test::lacks(kernel_set::avx512_bf16))) { \
    check(kernels::cpu_kernels(kernel_set::avx512_bf16.uses)->attention);                    \
  }                                                                                          \
  VLA_EMULATED_TEST("amx", sentence, check(kernels::kEmulatedAttentionAmx))                  \
  TEST_CASE("amx: " sentence* doctest::skip(test::lacks(kernel_set::amx))) {                 \
    check(kernels::cpu_kernels(kernel_set::amx.uses)->attention);                            \
  }

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
VLA_PAIR_TEST("a key with the logarithm of n in the mask is as n equal keys", check_pair_repeated)
VLA_PAIR_TEST("attention is right whatever the width of a head and the number of keys", check_pair_ends)
VLA_PAIR_TEST("attention keeps small weights, and greater scores make earlier ones smaller", check_pair_weights)
VLA_PAIR_TEST("attention's answer may be rounded, as the product behind it reads it", check_pair_rounded)
VLA_PAIR_TEST("attention reads rounded queries, keys and values as it rounds them itself", check_pair_operands)
VLA_PAIR_TEST("attention skips what a mask hides, and chunks that it hides whole", check_pair_masks)
VLA_PAIR_TEST("a query that sees nothing, and what is not finite, does not become an answer",
              check_attention_of_not_finite)

}  // namespace attention_pairs_test
