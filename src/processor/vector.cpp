// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/vector.h"

#include <fmt/format.h>

#include <cmath>

namespace vla {
namespace {

Result<std::vector<float>> read(const Bundle& bundle, const std::string& name, int width, const std::string& where) {
  VLA_TRY(std::vector<float> values, bundle.stats(name));
  if (values.size() == static_cast<std::size_t>(width)) return values;
  return Error{Code::bad_bundle, name, fmt::format("{} numbers for {}", width, where), std::to_string(values.size())};
}

}  // namespace

std::vector<std::string> statistics_of(const NormalizeOp& op) {
  constexpr const char* kLow[] = {"mean", "min", "q01", "q10"};
  constexpr const char* kHigh[] = {"std", "max", "q99", "q90"};
  if (op.kind == NormKind::identity) return {};
  const int kind = static_cast<int>(op.kind);
  return {op.stats + "." + kLow[kind], op.stats + "." + kHigh[kind]};
}

Normalizer::Normalizer(NormKind kind, Direction direction, float eps, std::vector<float> low, std::vector<float> high)
    : kind_(kind), direction_(direction), low_(std::move(low)), factor_(std::move(high)) {
  for (std::size_t i = 0; i < factor_.size(); ++i) {
    if (kind_ != NormKind::mean_std) {
      factor_[i] -= low_[i];
      if (factor_[i] == 0.0f) factor_[i] = eps;
    }
    divisor_.push_back(kind_ == NormKind::mean_std ? factor_[i] + eps : factor_[i]);
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
    if (divisor_[i] == 0.0f || !std::isfinite(divisor_[i]))
      return Error{Code::bad_bundle, op.stats, fmt::format("a spread to divide by in column {}", i),
                   fmt::format("{} with eps {}", divisor_[i], op.eps)};
  return {};
}

float Normalizer::normalized(float x, std::size_t column) const {
  const float centred = x - low_[column];
  return kind_ == NormKind::mean_std ? centred / divisor_[column] : 2.0f * centred / divisor_[column] - 1.0f;
}

float Normalizer::unnormalized(float x, std::size_t column) const {
  if (kind_ == NormKind::mean_std) return x * factor_[column] + low_[column];
  if (kind_ == NormKind::min_max) return (x + 1.0f) / 2.0f * factor_[column] + low_[column];
  return (x + 1.0f) * factor_[column] / 2.0f + low_[column];
}

void Normalizer::apply(std::span<float> values) const {
  if (kind_ == NormKind::identity) return;
  for (std::size_t i = 0; i < values.size(); ++i)
    values[i] = direction_ == Direction::normalize ? normalized(values[i], i) : unnormalized(values[i], i);
}

}  // namespace vla
