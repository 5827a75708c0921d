// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// As python/vla_cpp/control/limits.py, which explains it, operation by operation: both give the same bytes.
#include <fmt/format.h>
#include <vla/control.h>

#include <algorithm>
#include <cmath>
#include <limits>

namespace vla::control {
namespace {

constexpr int kHalf = 16;       // halvings of the search for a permitted command
constexpr int kMaxStop = 4096;  // steps of the longest stop that is looked for
constexpr double kUnlimited = 1e9, kSlack = 1e-9;
constexpr double kInfinity = std::numeric_limits<double>::infinity();

double clip(double x, double low, double high) { return std::min(std::max(x, low), high); }

/// The least sum of accelerations over n steps from `change` to rest.
double least_sum(double most, double jerk, double change, double n) {
  const double fall = clip(std::floor(std::min((change + most) / jerk, ((n + 1) * jerk + change) / (2 * jerk))), 0, n);
  const double rise = std::min(n - fall, std::floor(most / jerk));
  return fall * change - jerk * (fall * (fall + 1) / 2 + rise * (rise + 1) / 2) - (n - fall - rise) * most;
}

/// The least number of steps to rest; -1 beyond kMaxStop.
int least_steps(double most, double jerk, double velocity, double change) {
  const auto is_enough = [&](int steps) {
    const double n = steps, slack = kSlack * (1 + std::abs(velocity));
    return std::abs(change) <= (n + 1) * jerk + kSlack && least_sum(most, jerk, change, n) <= -velocity + slack &&
           -least_sum(most, jerk, -change, n) >= -velocity - slack;
  };
  int few = -1, many = 0;
  while (!is_enough(many)) {
    if (many >= kMaxStop) return -1;
    few = many, many = 2 * many + 1;
  }
  while (many - few > 1) {
    const int middle = std::max((few + many) / 2, 0);
    (is_enough(middle) ? many : few) = middle;
  }
  return many;
}

}  // namespace

Limiter::Limiter(const Limits& limits, double rate_hz) : refuse_above_(limits.refuse_above) {
  if (!(rate_hz > 0) || std::isinf(rate_hz))
    throw Error("usage", "rate_hz", "commands per second, above 0", fmt::format("{:g}", rate_hz));
  for (const Column& column : limits.columns) {
    Motion m;
    m.column = column, m.is_place = column.kind == Kind::position;
    const double first = column.kind == Kind::velocity ? 1.0 : 1 / rate_hz;
    const double low = column.low.value_or(-kUnlimited), high = column.high.value_or(kUnlimited);
    const double velocity = column.velocity.value_or(kInfinity) * first;
    const double acceleration = column.acceleration.value_or(kInfinity) * (first / rate_hz);
    const double jerk = column.jerk.value_or(kInfinity) * (first / (rate_hz * rate_hz));
    m.low = m.is_place ? low : -kInfinity, m.high = m.is_place ? high : kInfinity;
    // Where a limit is missing, one that the others imply: none of these is ever reached.
    const double step = std::min(velocity, m.is_place ? std::max(high - low, 0.0) : kUnlimited);
    m.slowest = m.is_place ? -step : std::max(low, -step);
    m.fastest = m.is_place ? step : std::min(high, step);
    m.acceleration = std::min(acceleration, 2 * (m.fastest - m.slowest) + kSlack);
    m.jerk = std::min(jerk, 2 * m.acceleration);
    m.stop.resize(2 * kMaxStop + 2), m.tried.resize(2 * kMaxStop + 2);
    motions_.push_back(std::move(m));
  }
  reset();
}

void Limiter::reset() noexcept {
  for (Motion& m : motions_) {
    m.place = m.is_place ? std::numeric_limits<double>::quiet_NaN() : 0;
    m.velocity = m.change = 0;
    m.stop_at = m.stop_size = 0;
  }
}

bool Limiter::is_ready() const noexcept {
  return std::none_of(motions_.begin(), motions_.end(), [](const Motion& m) { return std::isnan(m.place); });
}

void Limiter::rest_at(std::span<const double> values) {
  const bool is_row = values.size() == motions_.size() &&
                      std::all_of(values.begin(), values.end(), [](double x) { return std::isfinite(x); });
  if (!is_row)
    throw Error("bad_action", "rest_at", fmt::format("{} finite numbers", motions_.size()),
                fmt::format("{}", values.size()));
  for (std::size_t i = 0; i < motions_.size(); ++i) {
    const Motion& m = motions_[i];
    if (m.is_place && !(m.low <= values[i] && values[i] <= m.high))
      throw Error("usage", "limits." + m.column.name, fmt::format("{:g} to {:g}", m.low, m.high),
                  fmt::format("{:g}, where the robot is", values[i]));
  }
  reset();
  for (std::size_t i = 0; i < motions_.size(); ++i) motions_[i].place = motions_[i].is_place ? values[i] : 0;
}

/// Looks for a stop after a step with this acceleration. Returns its size, and its accelerations in `tried`; -1 for
/// none.
int Limiter::find_stop(Motion& m, double change) noexcept {
  const double velocity = m.velocity + change, place = m.is_place ? m.place + velocity : 0;
  const int n = least_steps(m.acceleration, m.jerk, velocity, change);
  if (n < 0) return -1;
  const auto bounds = [&](int i) {
    const double forth = i * m.jerk, back = std::max(n + 1 - i, 0) * m.jerk;
    return std::pair{std::max(std::max(-m.acceleration, change - forth), -back),
                     std::min(std::min(m.acceleration, change + forth), back)};
  };
  double lows = 0, room = 0;
  for (int i = 1; i <= n + 1; ++i) {
    const auto [low, high] = bounds(i);
    lows = i == 1 ? low : lows + low;
    room = i == 1 ? high - low : room + (high - low);
  }
  const double share = clip(room > 0 ? (-velocity - lows) / room : 0, 0, 1);
  const double slack = kSlack * (1 + std::abs(m.fastest)), edge = kSlack * (1 + (m.is_place ? std::abs(place) : 0.0));
  const auto is_speed = [&](double speed) { return speed >= m.slowest - slack && speed <= m.fastest + slack; };
  const auto is_within = [&](double at) { return !m.is_place || (at >= m.low - edge && at <= m.high + edge); };
  bool found = is_speed(velocity) && is_within(place);
  double steps = 0, speeds = 0;
  for (int i = 1; i <= n + 1; ++i) {
    const auto [low, high] = bounds(i);
    const double step = low + share * (high - low);
    m.tried[static_cast<std::size_t>(i - 1)] = step;
    steps = i == 1 ? step : steps + step;
    const double speed = velocity + steps;
    speeds = i == 1 ? speed : speeds + speed;
    found = found && is_speed(speed) && is_within(place + speeds);
  }
  return found ? n + 1 : -1;
}

/// The command of a column for a wanted value.
double Limiter::step_column(Motion& m, double wanted) noexcept {
  const double change = (m.is_place ? wanted - m.place : wanted) - m.velocity, ahead = m.place + m.velocity;
  const double low =
      std::max(std::max(std::max(-m.acceleration, m.change - m.jerk), m.slowest - m.velocity), m.low - ahead);
  const double high =
      std::min(std::min(std::min(m.acceleration, m.change + m.jerk), m.fastest - m.velocity), m.high - ahead);
  const double kept = m.stop_at < m.stop_size ? m.stop[m.stop_at] : 0;
  const bool is_inside = change >= low - kSlack * (1 + std::abs(low)) && change <= high + kSlack * (1 + std::abs(high));
  const double target = is_inside ? change : clip(change, std::min(low, kept), std::max(high, kept));
  double best = target, near = 0, far = 1;
  int size = find_stop(m, target);
  if (size < 0) {  // as near to it as a search by halves finds; in the worst case the next step of the kept stop
    best = kept;
    for (int i = 0; i < kHalf; ++i) {
      const double share = (near + far) / 2, tried = kept + share * (target - kept);
      const int found = find_stop(m, tried);
      if (found >= 0) {
        best = tried, size = found, near = share;
        std::swap(m.stop, m.tried);
        m.stop_at = m.stop_size = 0;  // `stop` is the found one from here on, and `kept` is a copy
      } else {
        far = share;
      }
    }
    if (size < 0 && m.stop_at < m.stop_size) ++m.stop_at;
    if (size >= 0) m.stop_at = 0, m.stop_size = static_cast<std::size_t>(size);
  } else {
    std::swap(m.stop, m.tried);
    m.stop_at = 0, m.stop_size = static_cast<std::size_t>(size);
  }
  m.change = best;
  m.velocity += best;
  const double out = m.is_place ? m.place + m.velocity : m.velocity;
  const bool is_cut = static_cast<float>(out) != static_cast<float>(wanted);
  const double command = is_cut ? out + 0.0 : wanted;
  m.place = m.is_place ? command : 0;
  return command;
}

int Limiter::step(std::span<const float> wanted, std::span<float> out, std::span<std::uint8_t> cut) noexcept {
  if (!is_ready()) return -1;
  int n_cut = 0;
  for (std::size_t i = 0; i < motions_.size(); ++i) {
    const float given = wanted[i];  // `out` may be the same memory
    out[i] = static_cast<float>(step_column(motions_[i], given));
    cut[i] = out[i] != given;
    n_cut += cut[i];
  }
  return n_cut;
}

int Limiter::breaks(std::span<const float> rows, int& first) noexcept {
  const std::size_t d = motions_.size(), n_row = rows.size() / d;
  int n_broken = 0;
  first = -1;
  const auto value = [&](std::size_t row, std::size_t i) { return static_cast<double>(rows[row * d + i]); };
  for (std::size_t i = 0; i < d; ++i) {
    double most = 0;
    for (std::size_t row = 0; row < n_row; ++row) most = std::max(most, std::abs(value(row, i)));
    motions_[i].rounding = 8 * static_cast<double>(std::numeric_limits<float>::epsilon()) * most;
  }
  const auto is_broken = [&](std::size_t row, std::size_t i) {
    const Motion& m = motions_[i];
    const double rounding = m.rounding;
    const auto velocity = [&](std::size_t r) {
      return !m.is_place ? value(r, i) : r == 0 ? 0 : value(r, i) - value(r - 1, i);
    };
    const auto change = [&](std::size_t r) { return velocity(r) - (r == 0 ? 0 : velocity(r - 1)); };
    if (m.is_place && (value(row, i) < m.low - rounding || value(row, i) > m.high + rounding)) return true;
    if (velocity(row) < m.slowest - rounding || velocity(row) > m.fastest + rounding) return true;
    const std::size_t known = m.is_place ? 2 : 1;  // row that has an acceleration: two velocities before it are known
    if (row >= known && std::abs(change(row)) > m.acceleration + 2 * rounding) return true;
    return row >= known + 1 && std::abs(change(row) - change(row - 1)) > m.jerk + 4 * rounding;
  };
  for (std::size_t row = 0; row < n_row; ++row) {
    bool broken = false;
    for (std::size_t i = 0; i < d && !broken; ++i) broken = is_broken(row, i);
    if (broken && n_broken++ == 0) first = static_cast<int>(row);
  }
  return n_broken;
}

}  // namespace vla::control
