// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/quantize.h"

#include <fmt/format.h>
#include <unistd.h>

#include <filesystem>

#include "cli/commands.h"
#include "cli/say.h"

namespace vla::cli {
namespace {

struct QuantizeOptions {
  std::string from, to, dtype = "int8";
  bool force = false, quiet = false;
};

std::string megabytes(std::int64_t bytes) { return fmt::format("{:.1f}", static_cast<double>(bytes) / 1e6); }

void print_row(const QuantizedModule& row, std::size_t width) {
  const std::string error = row.n_matrix > 0 ? fmt::format("{:.2f} %", 100 * row.error) : "";
  say(stdout, "{:<{}}  {:>8}  {:>10}  {:>10}  {:>8}\n", row.path, width, row.n_matrix, megabytes(row.before),
      megabytes(row.after), error);
}

void print(const std::vector<QuantizedModule>& rows) {
  std::size_t width = 6;
  QuantizedModule all = {.path = "all"};
  for (const QuantizedModule& row : rows) {
    width = std::max(width, row.path.size());
    all.n_matrix += row.n_matrix, all.before += row.before, all.after += row.after;
  }
  say(stdout, "{:<{}}  {:>8}  {:>10}  {:>10}  {:>8}\n", "module", width, "matrices", "before, MB", "after, MB",
      "error");
  for (const QuantizedModule& row : rows) print_row(row, width);
  say(stdout, "{:<{}}  {:>8}  {:>10}  {:>10}\n", all.path, width, all.n_matrix, megabytes(all.before),
      megabytes(all.after));
}

/// One line that is written over, where somebody looks.
void print_progress(QuantizeProgress at) {
  static std::int64_t shown = -1;
  const std::int64_t percent = 100 * at.done / std::max<std::int64_t>(at.all, 1);
  if (percent == shown) return;
  shown = percent;
  say(stderr, "\rquantizing {:>3} %{}", percent, percent >= 100 ? "\n" : "");
}

Status run(const QuantizeOptions& options) {
  std::error_code ignored;
  if (std::filesystem::exists(options.to, ignored) && !options.force)
    return Error{Code::usage, options.to, "a new file", "one that exists", "name another, or --force"};
  const Rounding codes = options.dtype == "int4" ? Rounding::int4 : Rounding::int8;
  const bool shows = !options.quiet && ::isatty(STDERR_FILENO) != 0;
  const auto progress = [shows](QuantizeProgress at) {
    if (shows) print_progress(at);
  };
  VLA_TRY(const std::vector<QuantizedModule> rows, quantize(options.from, options.to, codes, progress));
  if (shows) say(stderr, "\r{:<16}\r", "");
  if (!options.quiet) print(rows);
  return {};
}

}  // namespace

Command add_quantize(CLI::App& app) {
  auto options = std::make_shared<QuantizeOptions>();
  CLI::App* command = app.add_subcommand(
      "quantize", "Write a bundle with its large matrices in int8 or int4: a half or a quarter of bf16");
  command->footer(
      "The codes are those that --kernels int8 or int4 makes at every load, so the actions are the same; the file is\n"
      "smaller and ready sooner. int4 has codes of four bits and a step for each 64 of a row, and moves actions more.\n"
      "How far actions move from float32 is for you to judge, on your own observations:\n"
      "  vla quantize policy.gguf -o policy.int8.gguf\n"
      "  vla run policy.gguf ... --kernels float32 --tap '*' --taps-out expected.gguf\n"
      "  vla run policy.int8.gguf ... --tap '*' --taps-out got.gguf\n"
      "  vla compare expected.gguf got.gguf --only chunk\n"
      "error: root mean square of what quantization moved, of that of the matrices.");
  add_bundle(*command, options->from, true);
  add_text(*command, "-o,--output", options->to, "FILE", "The quantized bundle")->required();
  command->add_option("--dtype", options->dtype, "Codes of the large matrices (int8, int4; default int8)")
      ->check(CLI::IsMember({"int8", "int4"}));
  command->add_flag("--force", options->force, "Write over a file that exists");
  command->add_flag("--quiet", options->quiet, "Print nothing");
  return [options] { return run(*options); };
}

}  // namespace vla::cli
