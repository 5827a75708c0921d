// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/smoothing.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "quantize/graphs.h"
#include "quantize/smoothing_places.h"
#include "quantize/tensor_rows.h"

namespace vla {
namespace {

// Smallest and largest power of two of a factor. Smaller factors are not applied: weights of four bits would lose more
// than activations of eight bits gain.
constexpr int kLeastPower = 2, kMostPower = 12;

/// The largest magnitude of each channel of a value over tokens, solver steps and observations.
using Ranges = std::map<std::string, std::vector<float>>;

void widen_range(std::vector<float>& range, std::size_t d, std::span<const float> values) {
  range.resize(d);
  for (std::size_t i = 0; i < values.size(); i += d)
    for (std::size_t k = 0; k < d; ++k) range[k] = std::max(range[k], std::abs(values[i + k]));
}

/// Measures ranges over the observations; `chunks` receives their chunks.
Result<Ranges> measure_ranges(const std::string& bundle, const std::vector<SmoothingPlace>& places,
                              std::span<const Judged> observations, EngineOptions options, Chunks& chunks) {
  Ranges ranges;
  options.see_tap = [&](const std::string& path, auto shape, auto values) {
    widen_range(ranges[without_step(path)], static_cast<std::size_t>(shape.front()), values);
  };
  for (const SmoothingPlace& place : places) options.tap_pattern += fmt::format("{0},step.*.{0},", place.path);
  options.tap_pattern.pop_back();
  VLA_TRY(chunks, chunks_of(bundle, options, observations));
  return ranges;
}

/// Factors for rows and columns of a tensor; empty if all are 1. A vector counts as a row.
struct Factors {
  std::vector<float> rows, columns;
};

Status put_scaled(const Bundle& bundle, const TensorInfo& tensor, const Factors& factors, BundleFile& out) {
  return each_row(bundle, tensor, [&](std::int64_t row, std::span<float> values) {
    const float of_row = factors.rows.empty() ? 1 : factors.rows[static_cast<std::size_t>(row)];
    for (std::size_t k = 0; k < values.size(); ++k)
      values[k] *= of_row * (factors.columns.empty() ? 1 : factors.columns[k]);
    put_floats(values, tensor.type, out);
  });
}

/// The nearest power of two, or 1 if the factor is small.
float power_of_two(double value) {
  const int power = std::clamp(static_cast<int>(std::lround(std::log2(value))), -kMostPower, kMostPower);
  return std::abs(power) < kLeastPower ? 1 : std::ldexp(1.0f, power);
}

/// The divisors of channels relative to the geometric mean of all, so that most channels stay unchanged.
std::vector<float> divisors(const std::vector<float>& x, const std::vector<float>& w) {
  std::vector<double> ratios;
  double sum = 0;
  int n = 0;
  for (std::size_t i = 0; i < x.size(); ++i) {
    const bool is_read = x[i] > 0 && w[i] > 0 && std::isfinite(x[i] / w[i]);
    ratios.push_back(is_read ? std::sqrt(double{x[i]} / w[i]) : 0);
    if (is_read) sum += std::log2(ratios.back()), ++n;
  }
  const double mean = n > 0 ? std::exp2(sum / n) : 1;
  std::vector<float> by;
  for (const double ratio : ratios) by.push_back(ratio > 0 ? power_of_two(ratio / mean) : 1);
  return by;
}

void multiply(std::vector<float>& factors, const std::vector<float>& by, bool inverse) {
  factors.resize(by.size(), 1);
  for (std::size_t i = 0; i < by.size(); ++i) factors[i] *= inverse ? 1 / by[i] : by[i];
}

/// Makes the scaling of a place.
Result<Scaling> scaling_of(const SmoothingPlace& place, const std::vector<float>& range, const Bundle& bundle,
                           const TensorsOfParams& tensors) {
  Scaling made = {.path = place.path};
  std::vector<float> w(range.size());
  for (const Param* matrix : place.readers) {
    made.readers.push_back(tensors.of(matrix).name);
    VLA_CHECK(each_row(bundle, tensors.of(matrix), [&](std::int64_t, std::span<float> row) {
      for (std::size_t k = 0; k < row.size(); ++k) w[k] = std::max(w[k], std::abs(row[k]));
    }));
  }
  made.by = divisors(range, w);
  for (const Param* param : {place.weight, place.bias})
    if (param != nullptr)
      (param->storage == Storage::matrix ? made.rows : made.vectors).push_back(tensors.of(param).name);
  return made;
}

/// Returns the factors by tensor name.
std::map<std::string, Factors> factors_of(std::span<const Scaling> scalings) {
  std::map<std::string, Factors> factors;
  for (const Scaling& scaling : scalings) {
    for (const std::string& matrix : scaling.readers) multiply(factors[matrix].columns, scaling.by, false);
    for (const std::string& vector : scaling.vectors) multiply(factors[vector].columns, scaling.by, true);
    for (const std::string& matrix : scaling.rows) multiply(factors[matrix].rows, scaling.by, true);
  }
  return factors;
}

}  // namespace

Result<Smoothing> find_smoothing(const std::string& bundle, std::span<const Judged> observations,
                                 EngineOptions options) {
  options.kernels = "float32";
  SmoothingPlaces finder;
  VLA_TRY(const std::unique_ptr<Engine> engine,
          see_graphs(bundle, options, [&](const Graph& graph) { finder.see(graph); }));
  const std::vector<SmoothingPlace> places = finder.found();
  if (places.empty())
    return Error{Code::unsupported, bundle, "norms or gated MLPs whose channels may be divided", "none"};
  Smoothing found = {.n_place = static_cast<int>(places.size())};
  VLA_TRY(const Ranges ranges, measure_ranges(bundle, places, observations, options, found.chunks));
  VLA_TRY(const Bundle file, Bundle::open(bundle));
  const TensorsOfParams tensors(file, engine->robot().bundle());
  for (const SmoothingPlace& place : places) {
    const auto range = ranges.find(place.path);
    if (range == ranges.end()) continue;
    VLA_TRY(Scaling made, scaling_of(place, range->second, file, tensors));
    if (std::ranges::any_of(made.by, [](float by) { return by != 1; })) found.scalings.push_back(std::move(made));
  }
  return found;
}

Status write_smoothed(const std::string& from, const std::string& to, std::span<const Scaling> scalings) {
  VLA_TRY(const Bundle bundle, Bundle::open(from));
  const std::map<std::string, Factors> factors = factors_of(scalings);
  return write_changed(
      bundle, to, [&](const TensorInfo& tensor) { return factors.contains(tensor.name); },
      [&](const TensorInfo& tensor, BundleFile& out) {
        return put_scaled(bundle, tensor, factors.at(tensor.name), out);
      });
}

}  // namespace vla
