// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/leftover.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

namespace vla {
namespace {

using Kind = RealTimeChunking::Kind;

constexpr double kMaxGuidance = 1e6;

Error wrong(std::string what, std::string expected, std::string found) {
  return {Code::bad_observation, "leftover" + what, std::move(expected), std::move(found)};
}

Status check_rows(const Leftover& leftover, const ChunkShape& shape) {
  const auto width = static_cast<std::size_t>(shape.d_normalized), count = leftover.rows.size();
  if (count == 0 || count % width != 0 || count / width > static_cast<std::size_t>(shape.n_row))
    return wrong("", fmt::format("1 to {} rows of {} numbers", shape.n_row, width), fmt::format("{} numbers", count));
  const auto bad =
      std::find_if_not(leftover.rows.begin(), leftover.rows.end(), [](float x) { return std::isfinite(x); });
  if (bad != leftover.rows.end()) {
    const auto at = static_cast<std::size_t>(bad - leftover.rows.begin());
    return wrong(fmt::format("[{}][{}]", at / width, at % width), "a finite number", fmt::format("{}", *bad));
  }
  const int n_row = static_cast<int>(count / width);
  if (leftover.delay >= 0 && leftover.delay <= n_row) return {};
  return wrong(".delay", fmt::format("0 to {}, the rows that are left", n_row), std::to_string(leftover.delay));
}

/// The guidance's settings have no default, since each one changes the chunk.
Status check_guidance(const Leftover& leftover, Kind kind) {
  const auto& [rows, delay, schedule, max_guidance] = leftover;
  if (kind == Kind::inpainted) {
    if (schedule.empty() && !max_guidance) return {};
    return wrong("", "no schedule and no max_guidance, which this policy does not have", "one");
  }
  if (schedule != "zeros" && schedule != "ones" && schedule != "linear" && schedule != "exp")
    return wrong(".schedule", "zeros, ones, linear or exp", schedule.empty() ? "none" : schedule);
  if (max_guidance && *max_guidance > 0 && *max_guidance <= kMaxGuidance) return {};
  return wrong(".max_guidance", fmt::format("a number above 0, at most {}", kMaxGuidance),
               max_guidance ? fmt::format("{}", *max_guidance) : "none");
}

/// The weight of each of the `n_row` rows.
std::vector<float> row_weights(const std::string& schedule, int delay, int n_row) {
  std::vector<float> weights(static_cast<std::size_t>(n_row), schedule == "zeros" ? 0.0f : 1.0f);
  std::fill_n(weights.begin(), delay, 1.0f);
  if (schedule == "zeros" || schedule == "ones") return weights;
  for (int i = delay; i < n_row; ++i) {
    const double linear = 1 - double(i - delay + 1) / (n_row - delay + 1);
    weights[static_cast<std::size_t>(i)] =
        static_cast<float>(schedule == "linear" ? linear : linear * std::expm1(linear) / (std::exp(1.0) - 1));
  }
  return weights;
}

/// The weight of the guidance at `time`. Time falls from 1 (noise) to 0 (actions). In float32, as in the reference.
float guidance_at(double time, float most) {
  const auto tau = static_cast<float>(1 - time);
  const float left = (1 - tau) * (1 - tau), c = tau == 0 ? most : (1 - tau) / tau;
  return std::min(c * ((left + tau * tau) / left), most);
}

void guide(const Solver& solver, const Leftover& leftover, int n_row, std::span<float> keep, std::span<float> pull,
           std::size_t step) {
  const std::vector<float> weights = row_weights(leftover.schedule, leftover.delay, n_row);
  // The reference's time runs from 1 to 0. A solver that runs from 0 to 1 has the opposite velocity.
  const double time = std::abs(solver.t_end - solver.times[step].exact);
  const float guidance = guidance_at(time, static_cast<float>(*leftover.max_guidance));
  for (std::size_t row = 0; row < weights.size(); ++row) {
    keep[row] = 1 - guidance * weights[row] * static_cast<float>(time);
    pull[row] = guidance * weights[row] * (solver.dt < 0 ? 1.0f : -1.0f);
  }
}

/// The share of the velocity that each row keeps: 0 for frozen rows, then rising to 1.
void ramp(double rate, int delay, int n_row, std::span<float> keep) {
  std::fill_n(keep.begin(), delay, 0.0f);
  const auto rise = [rate](double x) { return 1 - std::exp(-rate * x); };
  const double whole = std::max(rise(1), 1e-8);
  for (int row = delay; row < n_row; ++row)
    keep[static_cast<std::size_t>(row)] =
        static_cast<float>(rise(double(row - delay + 1) / (n_row - delay + 1)) / whole);
}

}  // namespace

const char* kind_name(Kind kind) {
  switch (kind) {
    case Kind::guided:
      return "guided";
    case Kind::inpainted:
      return "inpainted";
    case Kind::none:
      break;
  }
  return "";
}

Result<Steering> steer(const RealTimeChunking& rtc, const Solver& solver, const Leftover& leftover,
                       const ChunkShape& shape, std::vector<float> start) {
  if (rtc.kind == Kind::none)
    return Error{Code::unsupported, "leftover", "a policy that goes on from the rows of its previous chunk",
                 "one that does not", "send the observation without them"};
  VLA_CHECK(check_rows(leftover, shape));
  VLA_CHECK(check_guidance(leftover, rtc.kind));
  const auto horizon = static_cast<std::size_t>(shape.horizon), d_action = static_cast<std::size_t>(shape.d_action),
             width = static_cast<std::size_t>(shape.d_normalized), n_row = leftover.rows.size() / width,
             n_step = solver.times.size();
  Steering out{std::move(start), std::vector<float>(horizon * d_action), std::vector<float>(n_step * horizon, 1.0f),
               std::vector<float>(n_step * horizon, 0.0f)};
  for (std::size_t row = 0; row < n_row; ++row)
    std::copy_n(leftover.rows.begin() + static_cast<std::ptrdiff_t>(row * width), width,
                out.target.begin() + static_cast<std::ptrdiff_t>(row * d_action));
  if (rtc.kind == Kind::inpainted) std::copy_n(out.target.begin(), n_row * d_action, out.start.begin());
  for (std::size_t k = 0; k < n_step; ++k) {
    const auto keep = std::span(out.keep).subspan(k * horizon, horizon),
               pull = std::span(out.pull).subspan(k * horizon, horizon);
    if (rtc.kind == Kind::guided)
      guide(solver, leftover, static_cast<int>(n_row), keep, pull, k);
    else
      ramp(rtc.ramp_rate, leftover.delay, static_cast<int>(n_row), keep);
  }
  return out;
}

}  // namespace vla
