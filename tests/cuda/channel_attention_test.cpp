// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/channel_attention.h"

#include <doctest/doctest.h>

#include <cmath>

#include "cuda/machine.h"
#include "cuda/numbers.h"

namespace channel_attention_test {

using namespace vla::cuda;
using namespace vla::test::cuda;

namespace {

/// In double, for rows `stride` apart.
std::vector<float> attended(const ChannelAttentionJob& job, const std::vector<float>& q, const std::vector<float>& k,
                            const std::vector<float>& v) {
  const int d = job.d_group();
  std::vector<float> y(static_cast<std::size_t>(job.d * job.n * job.n_view));
  const auto at = [](const std::vector<float>& x, std::int64_t stride, int token, int i) {
    return double{x[static_cast<std::size_t>(token * stride + i)]};
  };
  for (int view = 0; view < job.n_view; ++view)
    for (int group = 0; group < job.n_group; ++group)
      for (int i = group * d; i < (group + 1) * d; ++i) {
        std::vector<double> weight;
        double sum = 0;
        for (int j = group * d; j < (group + 1) * d; ++j) {
          double score = 0;
          for (int t = view * job.n; t < (view + 1) * job.n; ++t)
            score += at(q, job.q_stride, t, i) * at(k, job.k_stride, t, j);
          weight.push_back(std::exp(score / std::sqrt(job.n)));
          sum += weight.back();
        }
        for (int t = view * job.n; t < (view + 1) * job.n; ++t) {
          double mixed = 0;
          for (int j = 0; j < d; ++j)
            mixed += weight[static_cast<std::size_t>(j)] / sum * at(v, job.v_stride, t, group * d + j);
          y[static_cast<std::size_t>(t * job.d + i)] = static_cast<float>(mixed);
        }
      }
  return y;
}

}  // namespace

TEST_CASE("features attend to those of their group, of any number of tokens, groups and views") {
  for (const auto& [d, n, n_view, n_group] :
       {std::array{12, 7, 2, 3}, std::array{35, 130, 1, 1}, std::array{6, 1, 3, 6}, std::array{64, 20, 1, 1}}) {
    CAPTURE(d);
    ChannelAttentionJob job = {};
    job.d = d, job.n = n, job.n_view = n_view, job.n_group = n_group;
    job.q_stride = d + 3, job.k_stride = d, job.v_stride = d + 1;
    Numbers numbers;
    const std::vector<float> q = numbers.floats(static_cast<int>(job.q_stride) * n * n_view),
                             k = numbers.floats(d * n * n_view),
                             v = numbers.floats(static_cast<int>(job.v_stride) * n * n_view);
    const Device<float> gq(q), gk(k), gv(v), y(static_cast<std::size_t>(d * n * n_view));
    job.q = gq.get(), job.k = gk.get(), job.v = gv.get(), job.y = y.get();
    const std::vector<float> expected = attended(job, q, k, v);
    in_every_schedule([&] {
      launch(channel_attention(job), job);
      const std::vector<float> found = y.host();
      for (std::size_t i = 0; i < expected.size(); ++i) CHECK(found[i] == doctest::Approx(expected[i]).epsilon(1e-4));
    });
  }
}

}  // namespace channel_attention_test
