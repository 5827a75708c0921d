// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/calibrate.h"

#include <fmt/format.h>
#include <unistd.h>

#include <filesystem>
#include <optional>

#include "cli/commands.h"
#include "cli/say.h"
#ifdef VLA_SERVER
#include "cli/calibration.h"
#include "cli/signals.h"
#endif

namespace vla::cli {
namespace {

struct QuantizeOptions {
  std::string from, to, dtype = "int8";
  bool force = false, quiet = false;
  std::string recording;    // the recording for --judge
  std::string calibration;  // the recording for --calibrate
  Bound bound;
  int n_observation = 32;
  EngineOptions engine = {.all_robots = true};  // computes the observations
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

/// Prints the progress on one line of a terminal, over the last value.
void print_progress(QuantizeProgress at) {
  static std::int64_t shown = -1;
  const std::int64_t percent = 100 * at.done / std::max<std::int64_t>(at.all, 1);
  if (percent == shown) return;
  shown = percent;
  say(stderr, "\rquantizing {:>3} %{}", percent, percent >= 100 ? "\n" : "");
}

Rounding codes_of(const std::string& dtype) { return dtype == "int4" ? Rounding::int4 : Rounding::int8; }

#ifdef VLA_SERVER
std::string percent(const Moved& moved) {
  return fmt::format("{:.3f} % (largest {:.3f} %)", 100 * moved.rms, 100 * moved.largest);
}

const char* name_of(Rounding codes) {
  return codes == Rounding::int4 ? "int4" : codes == Rounding::int8 ? "int8" : "as stored";
}

void print(const Found& found, std::size_t n_observation) {
  std::size_t width = 5;
  for (const Block& block : found.blocks) width = std::max(width, block.path.size());
  say(stdout, "{:<{}}  {:<9}  {:>9}  {:>9}  {:>9}  {:>12}\n", "block", width, "codes", "stored MB", "int8, MB",
      "int4, MB", "int4 moves");
  for (const Block& block : found.blocks)
    say(stdout, "{:<{}}  {:<9}  {:>9}  {:>9}  {:>9}  {:>10.3f} %\n", block.path, width, name_of(block.codes),
        megabytes(block.stored), megabytes(block.int8), megabytes(block.int4), 100 * block.moved_by_int4);
  say(stdout, "chunks of {} observations move by {} of float32's; all int8: {}; all int4: {}\n", n_observation,
      percent(found.moved), percent(found.all_int8), percent(found.all_int4));
  // docs/quantization.md has the episodes.
  say(stdout,
      "a guide: the shipped MetaWorld policy, whose chunks move by 0.6 % in int8 and by 6.3 % in int4, solves 183 of "
      "200 episodes in both, and 182 in float32; beyond that, try it in closed loop\n\n");
}

/// The text about a search; the bundle stores it.
std::string told(const Found& found, const QuantizeOptions& options, std::size_t n_observation) {
  const auto n = [&](Rounding codes) { return std::ranges::count(found.blocks, codes, &Block::codes); };
  const std::string bound = options.bound.error ? fmt::format("error at most {}", *options.bound.error)
                                                : fmt::format("{} bytes at most", *options.bound.bytes);
  return fmt::format("{}: {} blocks in int4, {} in int8, {} as stored; chunks of {} observations move by {}", bound,
                     n(Rounding::int4), n(Rounding::int8), n(Rounding::none), n_observation, percent(found.moved));
}

/// Observations of a recording.
Result<std::vector<Judged>> observations(const QuantizeOptions& options, const std::string& recording) {
  return read_observations(recording, options.from, static_cast<std::size_t>(options.n_observation));
}

/// Chooses codes block by block. Returns them with the text that explains them.
Result<std::pair<Choice, std::string>> choose(const QuantizeOptions& options, const CodeSource& source, bool shows) {
  VLA_TRY(const std::vector<Judged> judged, observations(options, options.recording));
  const auto progress = [shows](int trial, const Moved& moved) {
    if (shows) say(stderr, "\rtrial {:>3}: {:<40}", trial, percent(moved));
  };
  VLA_TRY(const Found found,
          search(options.from, options.to + ".trial", judged, options.bound, options.engine, source, progress));
  if (shows) say(stderr, "\r{:<60}\r", "");
  if (!options.quiet) print(found, judged.size());
  if (std::ranges::all_of(found.blocks, [](const Block& block) { return block.codes == Rounding::none; }))
    return Error{Code::unsupported, options.from, "matrices that codes are good enough for", "none"};
  return std::pair(choice_of(found.blocks), told(found, options, judged.size()));
}

void add_search(CLI::App& command, QuantizeOptions& options) {
  CLI::Option* judge =
      add_text(command, "--judge", options.recording, "DIR",
               "A recording of vla serve --record: choose codes block by block by how far its actions move");
  CLI::Option* error =
      command
          .add_option(
              "--error", options.bound.error,
              "The fewest bytes whose chunks move by at most this share of float32's, by root mean square: 0.01")
          ->type_name("SHARE")
          ->check(CLI::Range(1e-6, 1.0));
  CLI::Option* size = add_bytes(command, "--size", options.bound.bytes,
                                "The least error of a file of at most so many bytes: 1.8GB, 900MB");
  add_text(command, "--calibrate", options.calibration, "DIR",
           "A recording of vla serve --record: first divide channels of activations that are far larger than the "
           "others, and multiply the matrices that read them, which leaves float32's actions as they are; then rotate "
           "channels, which only rounds the stored floats again; then round column by column, each making good the "
           "errors of those before it. Kept is what moves actions less");
  error->needs(judge)->excludes(size);
  size->needs(judge)->excludes("--dtype");
  error->excludes("--dtype");
  command.add_option("--observations", options.n_observation, "Of a recording, evenly spread (1 to 4096; default 32)")
      ->check(CLI::Range(1, 4096));
  add_memory(command, options.engine.memory);
  command.add_option("--threads", options.engine.n_thread, "CPU threads; 0 takes every core")
      ->check(CLI::Range(0, 512));
}
#endif

std::function<void(QuantizeProgress)> progress(bool shows) {
  return [shows](QuantizeProgress at) {
    if (shows) print_progress(at);
  };
}

/// `why`: what was done to `options.from` before.
Status write_codes(const QuantizeOptions& options, const CodeSource& source, const std::string& why) {
  const bool shows = !options.quiet && ::isatty(STDERR_FILENO) != 0;
  std::pair<Choice, std::string> chosen(all_as(codes_of(options.dtype)), why);
#ifdef VLA_SERVER
  if (!options.recording.empty()) {
    if (!options.bound.error && !options.bound.bytes)
      return Error{Code::usage, "--judge", "--error or --size", "neither"};
    VLA_TRY(chosen, choose(options, source, shows));
    if (!why.empty()) chosen.second = why + "; " + chosen.second;
  }
#endif
  VLA_TRY(const std::vector<QuantizedModule> rows,
          quantize(options.from, options.to, chosen.first, chosen.second, progress(shows), source));
  if (shows) say(stderr, "\r{:<16}\r", "");
  if (!options.quiet) print(rows);
  return {};
}

#ifdef VLA_SERVER
Status calibrate_first(QuantizeOptions options) {
  const bool shows = !options.quiet && ::isatty(STDERR_FILENO) != 0;
  VLA_TRY(std::vector<Judged> seen, observations(options, options.calibration));
  const Rounding codes = codes_of(options.dtype);
  const bool has_int4 = codes == Rounding::int4 || !options.recording.empty();
  VLA_TRY(const Calibrated made,
          calibrate(options.from, options.to, codes, has_int4, std::move(seen), options.engine, progress(shows)));
  for (const std::string& line : made.told)
    if (!options.quiet) say(stdout, "{}\n\n", line);
  options.from = made.bundle;
  std::vector<Bundle> bundles;
  for (const std::string& file : made.codes) {
    VLA_TRY(Bundle bundle, Bundle::open(file));
    bundles.push_back(std::move(bundle));
  }
  CodeSource source;
  for (const Bundle& bundle : bundles) source.made.push_back(&bundle);
  return write_codes(options, source, made.why);
}

/// The temporary bundles beside the result. They are removed at the start, since a killed program may have left some,
/// at the end, and when a signal ends the program.
class Trials {
 public:
  explicit Trials(const std::string& to) {
    for (const char* bundle : {"", ".smoothed", ".some", ".rotated", ".rotated2"})
      for (const char* ending : {"", ".codes", ".int8", ".int4", ".trial"})
        if (*bundle != 0 || *ending != 0) files_.push_back(to + bundle + ending);
    remove();
    signals_.emplace([](int signal) { remove(), EndSignals::end_by(signal); },
                     std::initializer_list<int>{SIGTERM, SIGINT, SIGHUP});
  }
  ~Trials() { remove(); }
  Trials(const Trials&) = delete;
  Trials& operator=(const Trials&) = delete;

 private:
  static void remove() {
    for (const std::string& file : files_) ::unlink(file.c_str());
  }
  static inline std::vector<std::string> files_;  // constant once a signal may arrive
  std::optional<EndSignals> signals_;
};
#endif

Status run(const QuantizeOptions& options) {
  std::error_code ignored;
  if (std::filesystem::is_regular_file(options.to, ignored) && !options.force)
    return Error{Code::usage, options.to, "a new file", "one that exists", "name another, or --force"};
#ifdef VLA_SERVER
  std::optional<Trials> trials;
  if (!options.calibration.empty() || !options.recording.empty()) trials.emplace(options.to);
  if (!options.calibration.empty()) return calibrate_first(options);
#endif
  return write_codes(options, {}, "");
}

}  // namespace

Command add_quantize(CLI::App& app) {
  auto options = std::make_shared<QuantizeOptions>();
  CLI::App* command = app.add_subcommand(
      "quantize", "Write a bundle with its large matrices in int8 or int4: a half or a quarter of bf16");
  command->footer(
      "The codes are those that --kernels int8 or int4 makes at every load, so the actions are the same; the file is\n"
      "smaller and ready sooner. int4 has codes of four bits and a step for each 64 of a row, and moves actions more,\n"
      "less so with --calibrate, which looks at what the matrices multiply.\n"
      "How far actions move from float32 is judged on your own observations, by the program or by you:\n"
      "  vla quantize policy.gguf -o policy.small.gguf --judge RECORDING --error 0.01\n"
      "  vla quantize policy.gguf -o policy.small.gguf --calibrate RECORDING --judge RECORDING --size 1.8GB\n"
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
#ifdef VLA_SERVER
  add_search(*command, *options);
#endif
  return [options] { return run(*options); };
}

}  // namespace vla::cli
