// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>

#include <charconv>
#include <iostream>

#include "base/file.h"
#include "bench/bench.h"
#include "bench/prediction.h"
#include "bench/roofline.h"
#include "bench/versus.h"
#include "cli/commands.h"
#include "cli/say.h"

namespace vla::cli {
namespace {

struct BenchOptions {
  std::string bundle, arch, size, dtype = "bf16", image_size, kernels, device, model, plot, vs, embodiment;
  std::optional<int> n_view, n_text;
  std::vector<int> steps;
  int n_thread = 0, n_round = 7, n_warmup = 1;
  std::size_t memory = 0;
  bool json = false, markdown = false, paced = false;
};

Status check(const BenchOptions& options) {
  if (options.bundle.empty() == options.arch.empty())
    return Error{Code::usage, "bench", "BUNDLE or --arch ARCH", options.bundle.empty() ? "neither" : "both"};
  if (options.arch.empty() != options.size.empty())
    return Error{Code::usage, "--size", "--arch and --size together", "one of them"};
  if (!options.plot.empty() && !options.device.empty() && options.device != "cpu")
    return Error{Code::usage, "--plot", "the CPU, whose roofline is measured", "--device " + options.device};
  if (!options.model.empty() && (options.markdown || !options.plot.empty() || !options.vs.empty() || options.paced))
    return Error{Code::usage, "--model", "at most --json beside the policy", "--markdown, --plot, --vs or --paced",
                 "a prediction is no measurement"};
  if (options.json && options.markdown)
    return Error{Code::usage, "--json", "--json or --markdown", "both", "run it twice to have both"};
  return {};
}

/// `HxW`, both above 0.
Status parse_size(const std::string& text, bench::WorkloadSizes& sizes) {
  const char *at = text.data(), *const end = at + text.size();
  const auto height = std::from_chars(at, end, sizes.height);
  const bool has_x = height.ec == std::errc() && height.ptr != end && *height.ptr == 'x';
  const auto width = has_x ? std::from_chars(height.ptr + 1, end, sizes.width) : height;
  constexpr int kMost = 8192;
  if (has_x && width.ec == std::errc() && width.ptr == end && std::min(sizes.height, sizes.width) > 0 &&
      std::max(sizes.height, sizes.width) <= kMost)
    return {};
  return Error{Code::usage, "--image-size", fmt::format("HEIGHTxWIDTH, each from 1 to {}", kMost), text};
}

DType dtype_of(const std::string& name) {
  for (DType type : {DType::f32, DType::f16})
    if (name == dtype_name(type)) return type;
  return DType::bf16;
}

Status wait_for_line() {
  std::string line;
  if (std::getline(std::cin, line)) return {};
  return Error{Code::usage, "--paced", "a line on standard input for each round", "its end"};
}

Status run_bench(const BenchOptions& options) {
  VLA_CHECK(check(options));
  bench::Request request{.bundle = options.bundle,
                         .arch = options.arch,
                         .dtype = dtype_of(options.dtype),
                         .sizes = {options.n_view, 0, 0, options.n_text},
                         .steps = options.steps,
                         .n_round = options.n_round,
                         .n_warmup = options.n_warmup,
                         .n_thread = options.n_thread,
                         .kernels = options.kernels,
                         .device = options.device,
                         .embodiment = options.embodiment,
                         .memory = options.memory};
  if (!options.image_size.empty()) VLA_CHECK(parse_size(options.image_size, request.sizes));
  if (!options.model.empty()) {
    VLA_TRY(const bench::GpuPrediction prediction, bench::predict(request, options.model));
    say_lines(stdout, options.json ? to_json(prediction) + "\n" : to_text(prediction));
    return {};
  }
  std::optional<bench::Earlier> earlier;
  if (!options.vs.empty()) {
    VLA_TRY(earlier, bench::Earlier::read(options.vs));
  }
  const auto accept = [&](const bench::Conditions& now) { return earlier ? earlier->check(now) : Status(); };
  const bench::Watcher watcher = {[](const std::string& line) { say(stderr, "{}\n", line); },
                                  [&] { return options.paced ? wait_for_line() : Status(); }};
  VLA_TRY(const bench::Report report, bench::measure(request, accept, watcher));
  if (!options.plot.empty()) VLA_CHECK(write_file(options.plot, draw_roofline(report)));
  if (options.json) {
    if (earlier) say_lines(stderr, earlier->compare(report));
    say_lines(stdout, to_json(report) + "\n");
    return {};
  }
  say_lines(stdout, options.markdown ? to_markdown(report) : to_text(report));
  if (earlier) say_lines(stdout, "\n" + earlier->compare(report));
  return {};
}

constexpr const char* kFooter = R"(Examples:
  vla bench policy.gguf
  vla bench policy.gguf --views 1 --steps 1,5,10 --plot roofline.svg
  vla bench --arch smolvla --size full --json > before.json; ...; vla bench --arch smolvla --size full --vs before.json

Each round is one observation (PNG frames, state, instruction in; actions out) between two short probes of the machine.
  GFLOP      work of the stage: two for each multiply-add of matrix and attention products, nothing for the rest
  GB         operands and results of its operations, in their stored dtype; caches serve a part of them
  FLOP/B     operational intensity, the first over the second; below the machine's own ratio memory is the bound
  floor      arithmetic at the machine's peak, or weights at its bandwidth, whichever is longer; "above": the median over it
  of peak    achieved rate over the multiply-add peak measured beside each round: median (best round). Ternary products
             refer to the peak of int8 products, all others to that of the kernels' floats
  time       of the threads in the round before the measured ones, by kind of operation. Norms that a product computes
             as it reads its operand are part of the product; those between ternary products make its codes
  network    the stages that compute on the device; total has the host's decoding and pre- and postprocessing too
Times are medians (p50) beside the 90th percentile and the fastest. Other programs on the machine make every figure
worse: "cores" says how many cores the rounds really had, and rounds that had fewer than most, or a lower peak, are named.)";

}  // namespace

Command add_bench(CLI::App& app) {
  auto options = std::make_shared<BenchOptions>();
  CLI::App* command = app.add_subcommand("bench", "Time a policy, stage by stage, beside what the machine can do");
  command->footer(kFooter);
  add_bundle(*command, options->bundle, false);
  add_text(*command, "--arch", options->arch, "ARCH", "Random weights of this architecture instead of a bundle");
  command->add_option("--size", options->size, "Size of the random weights: full, as published")
      ->check(CLI::IsMember({"full"}));
  command->add_option("--dtype", options->dtype, "Storage of the random weights")
      ->check(CLI::IsMember({"bf16", "f16", "f32"}))
      ->capture_default_str();
  command->add_option("--views", options->n_view, "Camera views; all of the bundle's if not given, 2 with --arch")
      ->check(CLI::Range(1, 16));
  add_text(*command, "--image-size", options->image_size, "HxW", "Raw frames; the network's own size if not given");
  command
      ->add_option("--tokens", options->n_text,
                   "Tokens of the instruction; the most that the bundle allows if not given, 48 with --arch")
      ->check(CLI::Range(1, 4096));
  command
      ->add_option("--steps", options->steps,
                   "Solver steps, or several for a line through them: 1,5,10; the report is of the last")
      ->delimiter(',')
      ->check(CLI::Range(1, 1000));
  command->add_option("--runs", options->n_round, "Rounds that are measured")
      ->check(CLI::Range(1, 10000))
      ->capture_default_str();
  command->add_option("--warmup", options->n_warmup, "Rounds before them")
      ->check(CLI::Range(0, 1000))
      ->capture_default_str();
  command->add_option("--threads", options->n_thread, "CPU threads; 0 takes every core, of big and little ones the big")
      ->check(CLI::Range(0, 512))
      ->capture_default_str();
  add_text(*command, "--kernels", options->kernels, "NAME", kKernelsHelp);
  add_text(*command, "--device", options->device, "NAME",
           std::string(kDeviceHelp) + ". Shares of a peak are the CPU's alone");
  add_memory(*command, options->memory);
  add_text(
      *command, "--model", options->model, "NAME",
      "With --device cuda: run nothing, and print what counts and published rates predict for a GPU that need not be "
      "there: orin-agx, rtx-3060, rtx-5090, h100 or h200");
  add_text(*command, "--embodiment", options->embodiment, "TAG", kEmbodimentHelp);
  command->add_flag("--json", options->json, "Print one JSON object as the last line of output");
  command->add_flag("--markdown", options->markdown, "Print a table for a document");
  add_text(*command, "--plot", options->plot, "FILE", "Also draw the roofline into this SVG file");
  command->add_flag("--paced", options->paced,
                    "Wait for a line on standard input before each round, so that programs can alternate");
  add_text(*command, "--vs", options->vs, "FILE", "Compare with an earlier run's --json");
  return [options] { return run_bench(*options); };
}

}  // namespace vla::cli
