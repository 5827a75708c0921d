// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The operations of python/vla_cpp/control/limits.py, which explains them, in the same order: both give the same bytes.
#include <fmt/format.h>
#include <vla/control.h>

#include <algorithm>
#include <cmath>
#include <limits>

namespace vla::control {
namespace {

constexpr int kHalf = 16;         // maximum halvings in the search for a permitted command
constexpr int kMostSteps = 8191;  // steps of the longest stop that is considered
constexpr double kUnlimited = 1e9, kSlack = 1e-9, kRounding = 1e-12;
constexpr double kInfinity = std::numeric_limits<double>::infinity();

double clip(double x, double low, double high) { return std::min(std::max(x, low), high); }

/// The least sum of accelerations over n steps from `change` to rest.
double least_sum(double most, double jerk, double change, double n) {
  const double fall = clip(std::floor(std::min((change + most) / jerk, ((n + 1) * jerk + change) / (2 * jerk))), 0, n);
  const double rise = std::min(n - fall, std::floor(most / jerk));
  return fall * change - jerk * (fall * (fall + 1) / 2 + rise * (rise + 1) / 2) - (n - fall - rise) * most;
}

/// The acceleration of step i of a stop of n + 1 steps.
inline double step_of(double most, double jerk, double change, double share, double n, double i) {
  const double forth = i * jerk, back = (n + 1 - i) * jerk;
  const double low = std::max(std::max(-most, change - forth), -back);
  const double high = std::min(std::min(most, change + forth), back);
  return low + share * (high - low);
}

}  // namespace

Limiter::Limiter(const Limits& limits, double rate_hz) : refuse_above_(limits.refuse_above) {
  if (!(rate_hz > 0) || std::isinf(rate_hz))
    throw Error("usage", "rate_hz", "commands per second, above 0", fmt::format("{:g}", rate_hz));
  for (const Column& column : limits.columns) {
    Motion m;
    m.column = column, m.is_place = column.kind == Kind::position;
    if (column.kind == Kind::gripper) {
      m.is_gripper = true, m.low = column.low.value_or(-kInfinity), m.high = column.high.value_or(kInfinity);
      motions_.push_back(std::move(m));
      continue;
    }
    const double first = column.kind == Kind::velocity ? 1.0 : 1 / rate_hz;
    const double low = column.low.value_or(-kUnlimited), high = column.high.value_or(kUnlimited);
    const double velocity = column.velocity.value_or(kInfinity) * first;
    const double acceleration = column.acceleration.value_or(kInfinity) * (first / rate_hz);
    const double jerk = column.jerk.value_or(kInfinity) * (first / (rate_hz * rate_hz));
    m.low = m.is_place ? low : -kInfinity, m.high = m.is_place ? high : kInfinity;
    // A missing limit gets a value that the other limits imply, so that it is never reached.
    const double step = std::min(velocity, m.is_place ? std::max(high - low, 0.0) : kUnlimited);
    m.slowest = m.is_place ? -step : std::max(low, -step);
    m.fastest = m.is_place ? step : std::min(high, step);
    m.acceleration = std::min(acceleration, 2 * (m.fastest - m.slowest) + kSlack);
    m.jerk = std::min(jerk, 2 * m.acceleration);
    motions_.push_back(std::move(m));
  }
  reset();
}

void Limiter::reset() noexcept {
  for (Motion& m : motions_) {
    m.place = m.is_place || m.is_gripper ? std::numeric_limits<double>::quiet_NaN() : 0;
    m.velocity = m.change = 0;
    m.stop = {};
    m.n_stop = m.n_gone = 0;
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
  for (std::size_t i = 0; i < motions_.size(); ++i)
    motions_[i].place = motions_[i].is_place || motions_[i].is_gripper ? values[i] : 0;
}

void Limiter::still(std::span<float> out) const noexcept {
  for (std::size_t i = 0; i < motions_.size(); ++i)
    out[i] = motions_[i].is_gripper ? static_cast<float>(motions_[i].place) : 0.0f;
}

/// Finds the smallest number of steps of a stop, and its share. Returns false beyond kMostSteps. If n steps suffice, n
/// + 1 do too, so the search begins near the previous result.
bool Limiter::find_steps(Motion& m, double velocity, Stop& stop) noexcept {
  const double slack = kSlack * (1 + std::abs(velocity)), change = stop.change;
  double least = 0, most = 0;  // sums of the least and of the largest accelerations
  const auto is_enough = [&](int n) {
    if (!(std::abs(change) <= (n + 1.0) * m.jerk * (1 + kRounding))) return false;
    least = least_sum(m.acceleration, m.jerk, change, n);
    if (!(least <= -velocity + slack)) return false;
    most = -least_sum(m.acceleration, m.jerk, -change, n);
    return most >= -velocity - slack;
  };
  int few = m.n_stop - 1, many = m.n_stop, stride = 1;
  if (is_enough(many)) {
    while (few >= 0 && is_enough(few)) many = few, few = std::max(few - stride, -1), stride *= 2;
  } else {
    do {
      if (many >= kMostSteps) return false;
      few = many, many = std::min(many + stride, kMostSteps), stride *= 2;
    } while (!is_enough(many));
  }
  while (many - few > 1) {
    const int middle = few + (many - few) / 2;
    (is_enough(middle) ? many : few) = middle;
  }
  is_enough(many);  // sets `least` and `most` for it
  m.n_stop = stop.n = many;
  const double room = most - least;
  stop.share = clip(room > 0 ? (-velocity - least) / room : 0, 0, 1);
  return true;
}

/// Finds the shortest stop after a step with this acceleration. Returns false if none keeps the limits.
bool Limiter::find_stop(Motion& m, double change, Stop& stop) noexcept {
  const double velocity = m.velocity + change, place = m.is_place ? m.place + velocity : 0;
  const double slack = kSlack * (1 + std::abs(m.fastest)), edge = kSlack * (1 + (m.is_place ? std::abs(place) : 0.0));
  const double slowest = m.slowest - slack, fastest = m.fastest + slack;
  const double least = m.low - edge, largest = m.high + edge;  // infinite unless the value is a position
  stop.change = change;
  if (velocity < slowest || velocity > fastest || place < least || place > largest) return false;
  if (!find_steps(m, velocity, stop)) return false;
  // The accelerations of a stop change sign at most once, to the opposite of `change`. After that, or if they never do,
  // the speed falls to zero: no later speed is larger, and the remaining way is at most the remaining steps at the
  // current speed.
  const bool is_straight = change * (2 * stop.share - 1) >= 0;
  const double n = stop.n, most = m.acceleration, jerk = m.jerk, share = stop.share;
  double steps = 0, speeds = 0;
  for (double i = 1; i <= n + 1; ++i) {
    const double step = step_of(most, jerk, change, share, n, i);
    steps = i == 1 ? step : steps + step;
    const double speed = velocity + steps;
    speeds = i == 1 ? speed : speeds + speed;
    const double at = place + speeds, last = at + (n + 1 - i) * speed;
    if (speed < slowest || speed > fastest || at < least || at > largest) return false;
    if ((is_straight || step * change <= 0) && last >= m.low && last <= m.high) return true;
  }
  return true;
}

/// The command of a column for a wanted value.
double Limiter::step_column(Motion& m, double wanted) noexcept {
  if (m.is_gripper) return m.place = clip(wanted, m.low, m.high);
  const double change = (m.is_place ? wanted - m.place : wanted) - m.velocity, ahead = m.place + m.velocity;
  const double low =
      std::max(std::max(std::max(-m.acceleration, m.change - m.jerk), m.slowest - m.velocity), m.low - ahead);
  const double high =
      std::min(std::min(std::min(m.acceleration, m.change + m.jerk), m.fastest - m.velocity), m.high - ahead);
  Stop stop = m.stop;
  const double kept =
      m.n_gone > stop.n ? 0 : step_of(m.acceleration, m.jerk, stop.change, stop.share, stop.n, m.n_gone + 1);
  const bool is_inside = change >= low - kSlack * (1 + std::abs(low)) && change <= high + kSlack * (1 + std::abs(high));
  const double target = is_inside ? change : clip(change, std::min(low, kept), std::max(high, kept));
  double best = target;
  bool is_found = find_stop(m, target, stop);
  if (!is_found) {  // bisects between the next step of the kept stop, which is the worst result, and `target`
    const double still = m.is_place ? ahead : m.velocity;
    const auto command = [&](double step) { return static_cast<float>(still + step); };
    double near = 0, far = 1, beyond = target;  // `beyond`: the nearest one that has no stop
    best = kept;
    for (int i = 0; i < kHalf && command(best) != command(beyond); ++i) {
      const double share = (near + far) / 2, tried = kept + share * (target - kept);
      Stop found;
      if (find_stop(m, tried, found)) {
        best = tried, near = share, stop = found, is_found = true;
      } else {
        beyond = tried, far = share;
      }
    }
  }
  if (is_found)
    m.stop = stop, m.n_gone = 0;
  else
    m.n_gone = std::min(m.n_gone, m.stop.n) + 1;
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
  for (std::size_t row = 0; row < n_row; ++row) {
    bool is_broken = false;
    for (std::size_t i = 0; i < d; ++i) {
      Motion& m = motions_[i];
      const Seen before = row == 0 ? Seen{value(0, i), 0, 0} : m.seen;
      const double place = value(row, i), moved = m.is_place ? place - before.place : place;
      const double velocity = m.is_gripper ? 0 : moved;
      const double change = velocity - before.velocity, rounding = m.rounding;
      const std::size_t known = m.is_place ? 2 : 1;  // first row with an acceleration, which needs two velocities
      is_broken |= (m.is_place || m.is_gripper) && (place < m.low - rounding || place > m.high + rounding);
      is_broken |= velocity < m.slowest - rounding || velocity > m.fastest + rounding;
      is_broken |= row >= known && std::abs(change) > m.acceleration + 2 * rounding;
      is_broken |= row >= known + 1 && std::abs(change - before.change) > m.jerk + 4 * rounding;
      m.seen = {place, velocity, change};
    }
    if (is_broken && n_broken++ == 0) first = static_cast<int>(row);
  }
  return n_broken;
}

}  // namespace vla::control
