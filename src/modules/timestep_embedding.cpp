// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/timestep_embedding.h"

#include <fmt/format.h>

#include <cmath>
#include <numbers>

namespace vla {
namespace {

std::vector<float> values_of(std::span<const SolverTime> times) {
  std::vector<float> values;
  for (const SolverTime& time : times) values.push_back(time.value);
  return values;
}

}  // namespace

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
  return g.constant(sinusoidal_time_embedding(values_of(times), d_, min_period_, max_period_),
                    {d_, static_cast<std::int64_t>(times.size()), 1, 1});
}

namespace {

float wave_exponent(float i, float n, TimeWaves waves) {
  const auto ln = static_cast<float>(std::log(waves == TimeWaves::slow_cosines ? 100.0 : 10000.0));
  switch (waves) {
    case TimeWaves::cosines_first:
      return -ln * i / (n - 1);
    case TimeWaves::sines_to_last:
      return -i * static_cast<float>(std::log(10000.0) / (static_cast<double>(n) - 1));
    case TimeWaves::sines_first:
      return -i * (ln / n);
    case TimeWaves::slow_cosines:
      break;
  }
  return -ln * i / n;
}

}  // namespace

std::vector<float> wave_embedding(std::span<const float> times, int d, TimeWaves waves) {
  const int half = d / 2;
  std::vector<float> table;
  for (const float time : times) {
    for (const bool first : {true, false})
      for (int i = 0; i < half; ++i) {
        const float exponent = wave_exponent(static_cast<float>(i), static_cast<float>(half), waves);
        const double angle = time * static_cast<float>(std::exp(double{exponent}));
        const bool sines_first = waves == TimeWaves::sines_first || waves == TimeWaves::sines_to_last;
        const bool cosine = first != sines_first;
        table.push_back(static_cast<float>(cosine ? std::cos(angle) : std::sin(angle)));
      }
    if (d % 2 == 1) table.push_back(0.0f);
  }
  return table;
}

Tensor wave_embedding(Graph& g, std::span<const SolverTime> times, int d, TimeWaves waves) {
  return g.constant(wave_embedding(values_of(times), d, waves), {d, static_cast<std::int64_t>(times.size()), 1, 1});
}

}  // namespace vla
