// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/attention_trial.h"

namespace attention_test {

using namespace vla;
using namespace vla::cuda;
using namespace vla::test::cuda;

namespace {

// Towers (72 and 80 wide, a batch of views), grouped heads, a prefix of keys before the step's own, few queries with
// keys split, the widest head, heads that no tile divides, and keys of several tiles in segments that end within them.
const AttentionCase kCases[] = {{70, 2, 2, 2, 72, 1, {70}},
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
const AttentionCase kClusterCases[] = {
    {9, 6, 2, 2, 40, 8, {100, 0, 60}, true, 70}, {13, 4, 1, 1, 64, 3, {290, 5}},         {1, 2, 2, 1, 24, 5, {33, 1}},
    {5, 8, 2, 1, 128, 2, {70, 150}, true},       {19, 2, 1, 2, 96, 7, {200}, true, 90},  {33, 1, 1, 1, 256, 5, {300}},
    {4, 10, 1, 1, 200, 8, {70, 63}, true, 60},   {5, 8, 1, 2, 256, 3, {100, 0, 5}, true}};

}  // namespace

TEST_CASE("attention on bf16 is within a rounding of its weights of doubles in every shape of blocks") {
  counts = {};
  for (const AttentionShape& shape : kAttentionShapes) {
    int n_run = 0;
    for (const AttentionCase& c : kCases) {
      if (depth_of(c.d_head) != shape.depth) continue;
      const AttentionTrial trial(c);
      const std::vector<double> expected = trial.expected();
      INFO(shape.kernel, ": ", c.n_query, " queries, heads of ", c.d_head);
      const auto start = [&](const AttentionJob& job) { launch(attention_bf16(shape, job), job); };
      in_every_schedule([&] {
        CHECK(error(trial.run_bf16(start, false), expected) < 4e-3);
        if (schedule.seed == 0) CHECK(error(trial.run_bf16(start, true), expected) < 8e-3);
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
    for (const AttentionCase& c : kClusterCases) {
      if (depth_of(c.d_head) != shape.depth || !shape.fits_cluster(c.n_split)) continue;
      const AttentionTrial trial(c);
      INFO(shape.kernel, ": ", c.n_query, " queries, heads of ", c.d_head, ", ", c.n_split, " shares");
      const auto run = [&](bool y_is_bf16, bool in_cluster) {
        const auto start = [&](const AttentionJob& job) { launch(attention_bf16(shape, job), job); };
        return trial.run_bf16(start, y_is_bf16, in_cluster);
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
  for (const AttentionCase& c : kCases) {
    const AttentionTrial trial(c);
    INFO(c.n_query, " queries, heads of ", c.d_head);
    in_every_schedule([&] {
      const auto start = [](const AttentionJob& job) { launch(attention_f32(job), job); };
      CHECK(error(trial.run_f32(start), trial.expected()) < 2e-6);
    });
  }
}

}  // namespace attention_test
