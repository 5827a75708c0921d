// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/chunk_limits.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>

#include "base/printable.h"

namespace vla::serve {
namespace {

constexpr const char* kOption = "--limits";

bool has_rate(const control::Column& column) { return column.velocity || column.acceleration || column.jerk; }

}  // namespace

Result<std::optional<control::Limits>> read_limits(const ServerOptions& options) {
  if (options.limits.empty() != options.on_limit.empty())
    return Error{Code::usage, kOption, "--limits FILE and --on-limit note or refuse together", "one of them"};
  if (options.limits.empty()) return std::optional<control::Limits>();
  try {
    return std::optional(control::Limits::read(options.limits));
  } catch (const control::Error& error) {
    return Error{Code::usage, kOption, "", error.what(), "docs/control.md describes them; vla-limits suggests some"};
  }
}

Result<ChunkLimits> ChunkLimits::of(const control::Limits& limits, const ServerOptions& options,
                                    const v1::Description& robot, const std::string& bundle) {
  control::Spec spec = {.bundle = bundle};
  for (const v1::Dimension& action : robot.actions()) {
    spec.action_names.push_back(printable(action.name()));
    spec.action_units.push_back(printable(action.unit()));
  }
  std::vector<std::string> limited;
  for (const control::Column& column : limits.columns) limited.push_back(printable(column.name));
  const std::vector<std::string>& actions = spec.action_names;
  const auto is_limited = [&](const std::string& name) {
    return !name.empty() && std::find(limited.begin(), limited.end(), name) != limited.end();
  };
  if (limited.size() != actions.size() || !std::all_of(actions.begin(), actions.end(), is_limited))
    return Error{Code::usage, kOption, fmt::format("the actions of {}: {}", bundle, fmt::join(actions, ", ")),
                 fmt::format("{}", fmt::join(limited, ", ")), "vla-limits check compares a file with a bundle"};
  if (!(robot.rate_hz() > 0) && std::any_of(limits.columns.begin(), limits.columns.end(), has_rate))
    return Error{Code::usage, kOption, "a bundle that says its control rate, for limits in seconds", bundle,
                 "ranges alone need none"};
  try {
    return ChunkLimits(limits.of(spec), robot.rate_hz() > 0 ? robot.rate_hz() : 1, options.on_limit == "refuse");
  } catch (const control::Error& error) {
    return Error{Code::usage, kOption, "", error.what()};
  }
}

ChunkLimits::ChunkLimits(const control::Limits& limits, double rate_hz, bool refuses)
    : all_(limits, rate_hz), refuses_(refuses) {
  for (const control::Column& column : limits.columns) {
    names_.push_back(printable(column.name));
    each_.emplace_back(control::Limits{.columns = {column}, .refuse_above = limits.refuse_above}, rate_hz);
  }
}

/// For example `12 of 50, from row 7 on: shoulder_pan (12), elbow (3)`.
std::string ChunkLimits::told(const ActionChunk& chunk, int n_beyond, int first) {
  std::vector<std::string> columns;
  std::vector<float> rows(static_cast<std::size_t>(chunk.horizon));
  for (std::size_t i = 0; i < each_.size(); ++i) {
    for (std::size_t row = 0; row < rows.size(); ++row) rows[row] = chunk.actions[row * each_.size() + i];
    int first_of_column = 0;
    if (const int n = each_[i].breaks(rows, first_of_column); n > 0)
      columns.push_back(fmt::format("{} ({})", names_[i], n));
  }
  return fmt::format("{} of {}, from row {} on: {}", n_beyond, chunk.horizon, first, fmt::join(columns, ", "));
}

Status ChunkLimits::check(ActionChunk& chunk, int& n_beyond) {
  int first = 0;
  n_beyond = all_.breaks(chunk.actions, first);
  if (n_beyond == 0) return {};
  const std::string found = told(chunk, n_beyond, first);
  if (static_cast<double>(n_beyond) / chunk.horizon > all_.refuse_above())
    return Error{Code::bad_action, "chunk",
                 fmt::format("at most a share of {:g} of its rows outside of the limits", all_.refuse_above()), found,
                 "statistics, units or the order of columns may be another robot's"};
  if (refuses_) return Error{Code::bad_action, "chunk", "no row outside of the limits, as --on-limit says", found};
  chunk.notes.push_back("limits: rows are outside: " + found);
  return {};
}

}  // namespace vla::serve
