// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The formulas of python/vla_cpp/control/interpolate.py, which explains them. Both agree within the rounding of double.
#include <fmt/format.h>
#include <vla/control.h>

#include <algorithm>
#include <cmath>

namespace vla::control {
namespace {

/// Maps place, velocity and acceleration at s = 0, and the same at s = 1, to the coefficients of s^0 ... s^5. s goes
/// from 0 to 1 over a period.
constexpr double kPowers[3][6][6] = {
    {{1, 0, 0, 0, 0, 0}, {-1, 0, 0, 1, 0, 0}},
    {{1, 0, 0, 0, 0, 0}, {0, 1, 0, 0, 0, 0}, {-3, -2, 0, 3, -1, 0}, {2, 1, 0, -2, 1, 0}},
    {{1, 0, 0, 0, 0, 0},
     {0, 1, 0, 0, 0, 0},
     {0, 0, 0.5, 0, 0, 0},
     {-10, -6, -1.5, 10, -4, 0.5},
     {15, 8, 1.5, -15, 7, -1},
     {-6, -3, -0.5, 6, -3, 0.5}},
};

bool is_number(double x) { return std::isfinite(x); }

}  // namespace

Interpolator::Interpolator(std::vector<Kind> kinds, Method method, double rate_hz)
    : method_(method), delay_s_(1 / rate_hz) {
  if (kinds.empty()) throw Error("usage", "kinds", "one for each column", "none");
  if (method == Method::unset) throw Error("usage", "method", "linear, cubic or minimum_jerk", "none");
  if (!(rate_hz > 0) || std::isinf(rate_hz))
    throw Error("usage", "rate_hz", "periods per second, above 0", fmt::format("{:g}", rate_hz));
  for (const Kind kind : kinds) columns_.push_back({kind, 0, {}});
}

void Interpolator::start_at(std::span<const double> values) {
  if (values.size() != columns_.size() || !std::all_of(values.begin(), values.end(), is_number))
    throw Error("bad_action", "start_at", fmt::format("{} finite numbers", columns_.size()),
                fmt::format("{}", values.size()));
  for (std::size_t i = 0; i < columns_.size(); ++i) {
    Motion& column = columns_[i];
    column.command = column.kind == Kind::position ? values[i] : 0;
    std::fill(std::begin(column.coefficients), std::end(column.coefficients), 0.0);
    column.coefficients[0] = column.command;
  }
  s_ = 1, has_start_ = true;
}

bool Interpolator::to(std::span<const float> values) noexcept {
  if (!has_start_ || values.size() != columns_.size() || !std::all_of(values.begin(), values.end(), is_number))
    return false;
  for (std::size_t i = 0; i < columns_.size(); ++i) {
    Motion& column = columns_[i];
    double now[3];
    motion(column, s_, now);
    const double wanted = values[i];
    const double ends[6] = {now[0], now[1], now[2], wanted, wanted - column.command, 0};
    for (int power = 0; power < 6; ++power) {
      double sum = 0;
      for (int end = 0; end < 6; ++end) sum += kPowers[static_cast<int>(method_) - 1][power][end] * ends[end];
      column.coefficients[power] = sum;
    }
    column.command = wanted;
  }
  s_ = 0;
  return true;
}

bool Interpolator::at(double s, std::span<float> out) noexcept {
  if (!has_start_ || !(s_ < s && s <= 1) || out.size() != columns_.size()) return false;
  for (std::size_t i = 0; i < columns_.size(); ++i) {
    const Motion& column = columns_[i];
    double now[3];
    motion(column, s, now);
    const double value = column.kind == Kind::position     ? now[0]
                         : column.kind == Kind::difference ? (s - s_) * column.command
                                                           : column.command;
    out[i] = static_cast<float>(value);
  }
  s_ = s;
  return true;
}

/// Place, velocity and acceleration of a column's polynomial, in periods.
void Interpolator::motion(const Motion& column, double s, double (&out)[3]) noexcept {
  out[0] = out[1] = out[2] = 0;
  for (int k = 5; k >= 0; --k) {
    out[2] = out[2] * s + 2 * out[1];
    out[1] = out[1] * s + out[0];
    out[0] = out[0] * s + column.coefficients[k];
  }
}

}  // namespace vla::control
