// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>

#include <algorithm>

#include "cli/commands.h"
#include "cli/say.h"
#include "engine/taps.h"

namespace vla::cli {
namespace {

struct CompareOptions {
  std::string expected, got, only = "*";
  double tolerance = 1e-4;
};

void print_row(const TapDifference& d, double tolerance, bool is_first_failure, std::size_t width) {
  const char* verdict = d.within(tolerance) ? "ok" : (d.comparable ? "FAIL" : "FAIL (shape, or not finite)");
  say(stdout, "{:<{}}  {:>9.2e}  {:>9.2e}  {:.8f}  {}{}\n", d.path, width, d.max_abs, d.relative, d.cosine, verdict,
      is_first_failure ? "  <- start here" : "");
}

Status compare(const CompareOptions& options) {
  VLA_TRY(const std::vector<Tap> expected, read_taps(options.expected));
  VLA_TRY(const std::vector<Tap> got, read_taps(options.got));
  std::vector<TapDifference> rows = compare_taps(expected, got);
  const std::size_t n_missing = expected.size() - rows.size();
  std::erase_if(rows, [&](const TapDifference& row) { return !match_path(options.only, row.path); });
  if (rows.empty())
    return Error{Code::mismatch, options.got, "taps that stand in both files", "none",
                 "record with vla run --tap '*' --taps-out FILE"};

  std::size_t width = 4;
  for (const TapDifference& row : rows) width = std::max(width, row.path.size());
  say(stdout, "{:<{}}  {:>9}  {:>9}  {:<10}  tolerance {:g} of the largest magnitude\n", "path", width, "max_abs",
      "relative", "cosine", options.tolerance);
  std::size_t n_failed = 0;
  for (const TapDifference& row : rows) {
    const bool failed = !row.within(options.tolerance);
    print_row(row, options.tolerance, failed && n_failed == 0, width);
    n_failed += failed;
  }
  say(stdout, "{} of {} taps within {:g}; {} of {} expected taps were not recorded\n", rows.size() - n_failed,
      rows.size(), options.tolerance, n_missing, expected.size());
  if (n_failed == 0) return {};
  const auto first =
      std::find_if(rows.begin(), rows.end(), [&](const TapDifference& row) { return !row.within(options.tolerance); });
  if (!first->comparable)
    return Error{Code::mismatch, first->path, "finite values of the expected shape", "other values",
                 "this is the first tap that differs"};
  return Error{Code::mismatch, first->path, fmt::format("a relative difference of at most {:g}", options.tolerance),
               fmt::format("{:.3g}", first->relative),
               fmt::format("{} of {} taps differ; this is the first", n_failed, rows.size())};
}

}  // namespace

Command add_compare(CLI::App& app) {
  auto options = std::make_shared<CompareOptions>();
  CLI::App* command =
      app.add_subcommand("compare", "Compare recorded taps with expected ones and show the first divergence");
  command->footer(
      "The taps are listed in the order in which the reference computes them, so the first FAIL is where to look.\n"
      "  vla run policy.gguf ... --tap '*' --taps-out got.gguf\n"
      "  vla compare tests/golden/smolvla/two_views/expected.gguf got.gguf");
  command->add_option("EXPECTED", options->expected, "Taps of the reference (GGUF)")->type_name("")->required();
  command->add_option("GOT", options->got, "Taps of a run (GGUF)")->type_name("")->required();
  add_text(*command, "--only", options->only, "PATTERN",
           "Compare only these paths; * stands for any characters, commas separate patterns");
  command
      ->add_option("--tolerance", options->tolerance,
                   "Largest difference allowed, relative to the largest expected magnitude of a tap")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  return [options] { return compare(*options); };
}

}  // namespace vla::cli
