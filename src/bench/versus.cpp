// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bench/versus.h"

#include <fmt/format.h>

#include <cmath>
#include <nlohmann/json.hpp>

#include "base/file.h"

namespace vla::bench {
namespace {

constexpr std::size_t kMaxFile = std::size_t{64} << 20;
constexpr double kSamePeak = 0.05;

/// Returns the last line of a program's output, which is the report.
std::string last_line(std::span<const std::byte> bytes) {
  std::string text(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  while (!text.empty() && (text.back() == '\n' || text.back() == '\r')) text.pop_back();
  return text.substr(text.rfind('\n') + 1);
}

std::string listed(const Conditions& c) {
  return fmt::format("{}, {} views {} x {}, {} tokens, {} steps", c.policy, c.n_view, c.width, c.height, c.n_text,
                     c.n_step);
}

}  // namespace

Result<Earlier> Earlier::read(const std::string& path) {
  VLA_TRY(const std::vector<std::byte> bytes, read_file(path, kMaxFile));
  using Json = nlohmann::ordered_json;
  Earlier earlier;
  earlier.path_ = path;
  try {  // nlohmann::json throws if a key is missing or has another type
    const Json root = Json::parse(last_line(bytes));
    const Json& c = root.at("conditions");
    earlier.conditions_ = {c.at("policy"),     c.at("weights"),    c.at("source"),          c.at("views"),
                           c.at("width"),      c.at("height"),     c.at("tokens"),          c.at("steps"),
                           root.at("threads"), root.at("kernels"), root.value("device", "")};
    earlier.cpu_ = root.at("cpu");
    earlier.peak_ = 1e9 * root.at("peak_gflops").get<double>();
    for (const auto& [stage, row] : root.at("stages").items())
      earlier.stages_.emplace_back(stage, row.at("p50_ms").get<double>());
  } catch (const Json::exception& exception) {
    return Error{Code::usage, "--vs " + path, "what vla bench --json printed", exception.what()};
  }
  return earlier;
}

Status Earlier::check(const Conditions& now) const {
  const std::string then_text = listed(conditions_), now_text = listed(now);
  if (then_text == now_text) return {};
  return Error{Code::usage, "--vs " + path_, "a report of " + now_text, then_text,
               "times of different work say nothing about speed"};
}

std::string Earlier::compare(const Report& now) const {
  std::string text = fmt::format("against {} ({}, {} threads, kernels: {}):\n", path_, cpu_, conditions_.n_thread,
                                 conditions_.kernels);
  for (const auto& [stage, before] : stages_) {
    const StageRow* row = now.find(stage);
    if (row == nullptr || row->p50 <= 0) continue;
    text += fmt::format("  {:<12}  {:>9.2f} ms then, {:>9.2f} ms now: {:.2f} times as fast\n", stage, before, row->p50,
                        before / row->p50);
  }
  if (std::abs(now.peak() / peak_ - 1) > kSamePeak)
    text += fmt::format(
        "  warning: the machine's own peak was {:.1f} GFLOP/s then and is {:.1f} now, so these ratios are not of the "
        "program alone; compare shares of the peak\n",
        1e-9 * peak_, 1e-9 * now.peak());
  return text;
}

}  // namespace vla::bench
