// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/calibrate.h"

#include <fmt/format.h>

#include <filesystem>

#include "quantize/hessians.h"
#include "quantize/smoothing.h"

namespace vla {
namespace {

const char* name_of(Rounding codes) { return codes == Rounding::int4 ? "int4" : "int8"; }

/// A bundle that may be quantized, and how far its codes move the actions.
struct Candidate {
  std::string bundle;
  std::string int4 = {};  // its codes by Hessians, where they are better than plain ones
  Moved moved = {};       // with the better codes
};

/// The steps of `calibrate` and their common state.
class Calibration {
 public:
  Calibration(const std::string& from, std::string to, std::span<const Judged> observations,
              const EngineOptions& options, const std::function<void(QuantizeProgress)>& report)
      : to_(std::move(to)), observations_(observations), options_(options), report_(report), kept_{from} {}

  /// Smooths, with Hessians behind it if `codes` is int4, and keeps the bundle whose codes move less in the end: what
  /// Hessians make good of plain codes' errors differs between the two.
  Status smooth_channels(Rounding codes) {
    Candidate smoothed = {to_ + ".smoothed"};
    VLA_TRY(Smoothed done, smooth(kept_.bundle, smoothed.bundle, observations_, options_));
    expected_ = std::move(done.chunks);
    std::string lines[2];
    for (Candidate* candidate : {&kept_, &smoothed}) {
      VLA_TRY(candidate->moved, moved_by(candidate->bundle, codes));
      if (codes == Rounding::int4) VLA_CHECK(round_by_hessians(*candidate, lines[candidate == &smoothed]));
    }
    const bool helps = smoothed.moved.rms < kept_.moved.rms;
    tell(fmt::format("{} channels of {} norms and MLPs divided, by {:g} at most; {} moves", done.n_channel,
                     done.n_place, done.largest, name_of(codes)),
         "smoothed", kept_.moved, smoothed.moved);
    drop(helps ? kept_.int4 : smoothed.bundle), drop(helps ? "" : smoothed.int4);
    if (helps) kept_ = std::move(smoothed);
    if (codes == Rounding::int4) take(lines[helps], !kept_.int4.empty());
    return {};
  }

  /// int4 of what is kept, by Hessians.
  Status round_kept_by_hessians() {
    if (expected_.empty()) {
      EngineOptions float32 = options_;
      float32.kernels = "float32";
      VLA_TRY(expected_, chunks_of(kept_.bundle, float32, observations_));
    }
    VLA_TRY(kept_.moved, moved_by(kept_.bundle, Rounding::int4));
    std::string line;
    VLA_CHECK(round_by_hessians(kept_, line));
    take(line, !kept_.int4.empty());
    return {};
  }

  Calibrated result() {
    made_.bundle = std::move(kept_.bundle), made_.int4 = std::move(kept_.int4);
    return std::move(made_);
  }

 private:
  static void drop(const std::string& file) {
    std::error_code ignored;
    if (!file.empty()) std::filesystem::remove(file, ignored);
  }

  /// Replaces plain codes of int4 by those that Hessians give, if these move chunks less. `line` says so.
  Status round_by_hessians(Candidate& candidate, std::string& line) {
    const std::string to = (candidate.bundle == kept_.bundle ? to_ : candidate.bundle) + ".int4";
    VLA_TRY(Hessians hessians, Hessians::of(candidate.bundle, observations_, options_));
    const Int4Codes codes = {
        [&](const Bundle& bundle, const TensorInfo& tensor) { return hessians.feedback(bundle, tensor); }};
    if (const auto made = quantize(candidate.bundle, to, all_as(Rounding::int4), {}, report_, codes); !made)
      return made.error();
    VLA_TRY(const Chunks chunks, chunks_of(to, options_, observations_));
    const Moved after = moved(expected_, chunks);
    line = line_of(fmt::format("errors of {} of {} matrices made good by later columns (GPTQ); int4 moves",
                               hessians.n_known(), hessians.n_asked()),
                   "rounded by Hessians", candidate.moved, after);
    if (after.rms < candidate.moved.rms)
      candidate.moved = after, candidate.int4 = to;
    else
      drop(to);
    return {};
  }

  /// How far one kind of codes alone moves the chunks.
  Result<Moved> moved_by(const std::string& bundle, Rounding codes) {
    const std::string trial = to_ + ".trial";
    if (const auto made = quantize(bundle, trial, all_as(codes), {}, [](QuantizeProgress) {}); !made)
      return made.error();
    VLA_TRY(const Chunks chunks, chunks_of(trial, options_, observations_));
    return moved(expected_, chunks);
  }

  std::string line_of(const std::string& done, const char* name, const Moved& before, const Moved& after) const {
    return fmt::format("{}{} over {} observations: {} chunks by {:.3f} % instead of {:.3f} %",
                       after.rms < before.rms ? "" : "not ", name, observations_.size(), done, 100 * after.rms,
                       100 * before.rms);
  }
  void tell(const std::string& done, const char* name, const Moved& before, const Moved& after) {
    take(line_of(done, name, before, after), after.rms < before.rms);
  }
  void take(const std::string& line, bool helps) {
    made_.told.push_back(line);
    if (helps) made_.why += (made_.why.empty() ? "" : "; ") + line;
  }

  const std::string to_;
  const std::span<const Judged> observations_;
  const EngineOptions& options_;
  const std::function<void(QuantizeProgress)>& report_;
  Chunks expected_;  // in float32
  Candidate kept_;
  Calibrated made_;
};

}  // namespace

Result<Calibrated> calibrate(const std::string& from, const std::string& to, Rounding codes, bool has_int4,
                             std::span<const Judged> observations, const EngineOptions& options,
                             const std::function<void(QuantizeProgress)>& report) {
  Calibration calibration(from, to, observations, options, report);
  const Status smoothed = calibration.smooth_channels(codes);
  const bool may_go_on = has_int4 && !smoothed && smoothed.error().code == Code::unsupported;
  if (!may_go_on) VLA_CHECK(smoothed);
  const bool has_hessians = smoothed && codes == Rounding::int4;
  if (has_int4 && !has_hessians) VLA_CHECK(calibration.round_kept_by_hessians());
  return calibration.result();
}

}  // namespace vla
