// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Operations of SmolVLA's published size, counted by hand from its configuration.
#include "kernels/kernel_set.h"
#include "support/weightless.h"

namespace work_test {

using namespace vla;
using namespace vla::test;

namespace {

/// Products of one token with the matrices of a layer, as multiply-adds.
double products(double d_in, double d_out) { return d_in * d_out; }

/// Both products of an attention: queries with keys, weights with values.
double attention(double n_query, double n_key, double d_query) { return 2 * n_query * n_key * d_query; }

struct Expected {
  double vision, prefix, step;
};

Expected count_by_hand(double n_view, double n_text) {
  // 512 x 512 pixels in patches of 16 x 16; 12 layers of width 768, feed-forward 3072; 4 x 4 patches become one token.
  const double n_patch = 1024;
  const double vision_layer =
      n_patch * (4 * products(768, 768) + 2 * products(768, 3072)) + attention(n_patch, n_patch, 768);
  const double vision =
      n_view * (n_patch * products(3 * 16 * 16, 768) + 12 * vision_layer + n_patch / 16 * products(768 * 16, 960));
  // 16 layers of width 960 with 15 query heads and 5 key heads of 64, feed-forward 2560; the last layer stops at its
  // keys and values. The 8 cross layers of the expert project keys and values of width 320 once more.
  const double n = 64 * n_view + n_text + 1, d_key = 5 * 64, d_query = 15 * 64;
  const double rest = n * (2 * products(960, d_query) + 3 * products(960, 2560)) + attention(n, n, d_query);
  const double prefix =
      products(32, 960) + 16 * n * 2 * products(960, d_key) + 15 * rest + 8 * n * 2 * products(d_key, d_key);
  // 50 rows of actions through 16 layers of width 720, feed-forward 2048: 8 see the prefix and themselves, 8 the
  // prefix.
  const double m = 50;
  const double common = m * (2 * products(720, d_query) + 3 * products(720, 2048));
  const double self = m * 2 * products(720, d_key) + attention(m, n + m, d_query), cross = attention(m, n, d_query);
  const double ends = m * (products(32, 720) + products(1440, 720) + products(720, 720) + products(720, 32));
  return {2 * vision, 2 * prefix, 2 * (ends + 16 * common + 8 * self + 8 * cross)};
}

}  // namespace

TEST_CASE("the published SmolVLA counts the operations of its configuration, under every choice of kernels") {
  for (const KernelSet& set : usable_kernels()) {
    CAPTURE(name_of(set));
    const WeightlessSmolVla smolvla(10, name_of(set));
    Plans plans = smolvla.plans();
    for (const auto& [n_view, n_text] : {std::pair(2, 48), std::pair(1, 5)}) {
      const auto plan = plans.for_shape(smolvla.network(), {512, 512, n_view, n_text, 32});
      REQUIRE(plan.ok());
      const StageWork work = (*plan)->work(10);
      const Expected expected = count_by_hand(n_view, n_text);
      REQUIRE(work.size() == 3);
      CHECK(work[0].first == "vision");
      CHECK(work[0].second.flop == doctest::Approx(expected.vision).epsilon(1e-12));
      CHECK(work[1].second.flop == doctest::Approx(expected.prefix).epsilon(1e-12));
      CHECK(work[2].second.flop == doctest::Approx(10 * expected.step).epsilon(1e-12));
      // Every stage moves at least the weights that it multiplies with, in 16 bits or more.
      CHECK(work[0].second.bytes > 2 * 98e6);
      CHECK(work[2].second.bytes > 10 * 2 * 90e6);
    }
  }
  const Expected published = count_by_hand(2, 48);  // the reference computes 593: a whole last layer, keys in each step
  CHECK((published.vision + published.prefix + 10 * published.step) * 1e-9 == doctest::Approx(590).epsilon(0.001));
}

}  // namespace work_test
