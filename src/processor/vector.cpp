// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/vector.h"

#include <fmt/format.h>

#include <cmath>
#include <utility>

namespace vla {
namespace {

Result<std::vector<float>> read(const Bundle& bundle, const std::string& name, int width, const std::string& where) {
  VLA_TRY(std::vector<float> values, bundle.stats(name));
  if (values.size() == static_cast<std::size_t>(width)) return values;
  return Error{Code::bad_bundle, name, fmt::format("{} numbers for {}", width, where), std::to_string(values.size())};
}

bool is_mean_std(NormKind kind) {
  return kind == NormKind::mean_std || kind == NormKind::openpi_mean_std || kind == NormKind::evo1_mean_std ||
         kind == NormKind::groot_mean_std;
}

bool is_min_max(NormKind kind) {
  return kind == NormKind::min_max || kind == NormKind::evo1_min_max || kind == NormKind::groot_min_max;
}

bool is_openpi(NormKind kind) { return kind == NormKind::openpi_mean_std || kind == NormKind::openpi_quantiles; }

bool is_evo1(NormKind kind) {
  return kind == NormKind::evo1_mean_std || kind == NormKind::evo1_min_max || kind == NormKind::evo1_quantiles;
}

std::pair<const char*, const char*> statistics_names(NormKind kind) {
  if (is_mean_std(kind)) return {"mean", "std"};
  if (is_min_max(kind)) return {"min", "max"};
  return kind == NormKind::quantile10 ? std::pair("q10", "q90") : std::pair("q01", "q99");
}

}  // namespace

std::vector<std::string> statistics_of(const NormalizeOp& op) {
  if (op.kind == NormKind::identity) return {};
  const auto [low, high] = statistics_names(op.kind);
  return {op.stats + "." + low, op.stats + "." + high};
}

Normalizer::Normalizer(NormKind kind, Direction direction, double eps, std::vector<float> low, std::vector<float> high)
    : kind_(kind), direction_(direction), low_(std::move(low)), factor_(std::move(high)) {
  for (std::size_t i = 0; i < factor_.size(); ++i) {
    if (is_openpi(kind_)) {
      const double high_i = static_cast<double>(factor_[i]);
      spread_.push_back((is_mean_std(kind_) ? high_i : high_i - static_cast<double>(low_[i])) + eps);
      divisor_.push_back(static_cast<float>(spread_[i]));
      continue;
    }
    const auto small = static_cast<float>(eps);
    if (!is_mean_std(kind_)) factor_[i] -= low_[i];
    if (is_evo1(kind_)) {
      factor_[i] += small;
    } else if (!is_mean_std(kind_) && !is_groot(kind_) && factor_[i] == 0.0f) {
      factor_[i] = small;
    }
    divisor_.push_back(kind_ == NormKind::mean_std ? factor_[i] + small : factor_[i]);
  }
}

Result<Normalizer> Normalizer::create(const Bundle& bundle, const NormalizeOp& op, Direction direction, int width,
                                      const std::string& where) {
  const std::vector<std::string> names = statistics_of(op);
  if (names.empty()) return Normalizer(op.kind, direction, op.eps, {}, {});
  VLA_TRY(std::vector<float> low, read(bundle, names[0], width, where));
  VLA_TRY(std::vector<float> high, read(bundle, names[1], width, where));
  Normalizer normalizer(op.kind, direction, op.eps, std::move(low), std::move(high));
  if (direction == Direction::normalize) VLA_CHECK(normalizer.check_divisors(op));
  return normalizer;
}

Status Normalizer::check_divisors(const NormalizeOp& op) const {
  for (std::size_t i = 0; i < divisor_.size(); ++i)
    if ((divisor_[i] == 0.0f && !is_groot(kind_)) || !std::isfinite(divisor_[i]))
      return Error{Code::bad_bundle, op.stats, fmt::format("a spread to divide by in column {}", i),
                   fmt::format("{} with eps {}", divisor_[i], op.eps)};
  return {};
}

double Normalizer::openpi(double x, std::size_t column) const {
  const double low = static_cast<double>(low_[column]), spread = spread_[column];
  const bool normalize = direction_ == Direction::normalize;
  if (is_mean_std(kind_)) return normalize ? (x - low) / spread : x * spread + low;
  return normalize ? (x - low) / spread * 2.0 - 1.0 : (x + 1.0) / 2.0 * spread + low;
}

float Normalizer::groot(float x, std::size_t column) const {
  const bool normalize = direction_ == Direction::normalize;
  if (kind_ == NormKind::groot_min_max) {
    if (!normalize) return (x + 1.0f) * 0.5f * factor_[column] + low_[column];
    return factor_[column] == 0.0f ? 0.0f : 2.0f * (x - low_[column]) / factor_[column] - 1.0f;
  }
  const double wide = static_cast<double>(x), mean = static_cast<double>(low_[column]);
  const double std = static_cast<double>(factor_[column]);
  if (std == 0.0) return x;
  return static_cast<float>(normalize ? (wide - mean) / std : wide * std + mean);
}

float Normalizer::normalized(float x, std::size_t column) const {
  const float centred = x - low_[column];
  return is_mean_std(kind_) ? centred / divisor_[column] : 2.0f * centred / divisor_[column] - 1.0f;
}

float Normalizer::unnormalized(float x, std::size_t column) const {
  if (is_mean_std(kind_)) return x * factor_[column] + low_[column];
  if (is_min_max(kind_) || is_evo1(kind_)) return (x + 1.0f) / 2.0f * factor_[column] + low_[column];
  return (x + 1.0f) * factor_[column] / 2.0f + low_[column];
}

void Normalizer::apply(std::span<float> values) const {
  if (kind_ == NormKind::identity) return;
  if (is_openpi(kind_)) {
    for (std::size_t i = 0; i < values.size(); ++i)
      values[i] = static_cast<float>(openpi(static_cast<double>(values[i]), i));
    return;
  }
  if (is_groot(kind_)) {
    for (std::size_t i = 0; i < values.size(); ++i) values[i] = groot(values[i], i);
    return;
  }
  for (std::size_t i = 0; i < values.size(); ++i)
    values[i] = direction_ == Direction::normalize ? normalized(values[i], i) : unnormalized(values[i], i);
}

}  // namespace vla
