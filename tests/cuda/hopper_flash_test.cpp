// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/hopper_flash.h"

#include "cuda/attention_trial.h"

namespace hopper_flash_test {

using namespace vla;
using namespace vla::cuda;
using namespace vla::test::cuda;

namespace {

// For every depth: less than a block of rows and more, grouped heads whose rows no block divides, fewer keys than a
// tile has, more than there is room for, and tiles that end in one; a batch; heads that are less than the depth, of
// which TMA must not read the neighbours; tiles, at the beginning or the end, of which some rows see nothing; shares of
// the keys, also without keys.
const AttentionCase kFlashCases[] = {{70, 2, 2, 2, 64, 1, {300}},
                                     {47, 6, 2, 1, 48, 1, {130}, true, -128},
                                     {25, 3, 1, 1, 40, 4, {150}, true, 60},
                                     {70, 2, 2, 2, 72, 1, {70}},
                                     {131, 1, 1, 1, 80, 1, {515}},
                                     {20, 4, 4, 1, 72, 2, {260}},
                                     {65, 2, 1, 1, 128, 1, {194}, true, 100},
                                     {35, 4, 2, 2, 96, 2, {170}, true, -80},
                                     {33, 4, 1, 1, 256, 1, {200}, true, 70},
                                     {20, 1, 1, 2, 200, 3, {100}}};

void launch_flash(const FlashShape& shape, const AttentionJob& attention) {
  FlashJob job = {.k = {}, .v = {}, .attention = attention};
  job.k = map_heads(mapped_heads(shape, attention, attention.segment[0].k));
  job.v = map_heads(mapped_heads(shape, attention, attention.segment[0].v));
  launch(hopper_flash(shape, attention), job);
}

}  // namespace

TEST_CASE("attention by wgmma is within a rounding of its weights of doubles in every shape of blocks") {
  if (!is_hopper()) {
    MESSAGE("skipped: no device of compute capability 9.0");
    return;
  }
  counts = {};
  for (const FlashShape& shape : kFlashShapes) {
    int n_run = 0;
    for (const AttentionCase& c : kFlashCases) {
      if (depth_of(c.d_head) != shape.depth) continue;
      const AttentionTrial trial(c);
      const std::vector<double> expected = trial.expected();
      INFO(shape.kernel, ": ", c.n_query, " queries, heads of ", c.d_head);
      const auto start = [&](const AttentionJob& job) { launch_flash(shape, job); };
      in_two_schedules(static_cast<std::size_t>((&c - kFlashCases) + (&shape - kFlashShapes)),
                       [&] { CHECK(error(trial.run_bf16(start, false), expected) < 4e-3); });
      CHECK(error(trial.run_bf16(start, true), expected) < 8e-3);
      ++n_run;
    }
    CHECK(n_run > 0);
  }
  CHECK(counts.bank_conflicts == 0);
}

TEST_CASE("blocks of attention by wgmma fit the shared memory of Hopper") {
  for (const FlashShape& shape : kFlashShapes) CHECK(shape.shared() <= static_cast<int>(kHopperShared));
}

}  // namespace hopper_flash_test
