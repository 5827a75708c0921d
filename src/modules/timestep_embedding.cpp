// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/timestep_embedding.h"

#include <fmt/format.h>

#include <cmath>
#include <numbers>

namespace vla {

std::vector<float> sinusoidal_time_embedding(std::span<const float> times, int d, double min_period,
                                             double max_period) {
  const int half = d / 2;
  std::vector<float> table;
  for (float time : times) {
    const auto angle = [&](int i) {
      const double fraction = half > 1 ? static_cast<double>(i) / (half - 1) : 0.0;
      const double period = min_period * std::pow(max_period / min_period, fraction);
      return 1.0 / period * 2 * std::numbers::pi * double{time};
    };
    for (int i = 0; i < half; ++i) table.push_back(static_cast<float>(std::sin(angle(i))));
    for (int i = 0; i < half; ++i) table.push_back(static_cast<float>(std::cos(angle(i))));
  }
  return table;
}

TimestepEmbedding::TimestepEmbedding(const Scope& s, int d)
    : d_(d), min_period_(s.precise("min_period", kPeriod)), max_period_(s.precise("max_period", kPeriod)) {
  s.require(max_period_ >= min_period_, "min_period", "at most max_period", fmt::format("{}", min_period_));
  s.require(d % 2 == 0, "width", "an even expert.d_model, for sines and cosines", std::to_string(d));
}

Tensor TimestepEmbedding::operator()(Graph& g, std::span<const SolverTime> times) const {
  std::vector<float> values;
  for (const SolverTime& time : times) values.push_back(time.value);
  return g.constant(sinusoidal_time_embedding(values, d_, min_period_, max_period_),
                    {d_, static_cast<std::int64_t>(times.size()), 1, 1});
}

std::vector<float> bucket_embedding(std::span<const int> buckets, int d, BucketWaves waves) {
  const int half = d / 2;
  const auto ln = static_cast<float>(std::log(10000.0));
  const auto frequency = [&](int i) {
    const auto n = static_cast<float>(i), m = static_cast<float>(half);
    const float exponent = waves == BucketWaves::cosines_first ? -ln * n / (m - 1) : -n * (ln / m);
    return static_cast<float>(std::exp(double{exponent}));
  };
  std::vector<float> table;
  for (const int bucket : buckets)
    for (const bool first : {true, false})
      for (int i = 0; i < half; ++i) {
        const double angle = static_cast<float>(bucket) * frequency(i);
        const bool cosine = first == (waves == BucketWaves::cosines_first);
        table.push_back(static_cast<float>(cosine ? std::cos(angle) : std::sin(angle)));
      }
  return table;
}

}  // namespace vla
