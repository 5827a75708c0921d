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

/// The steps of `calibrate` and their common state.
class Calibration {
 public:
  Calibration(const std::string& from, std::string to, std::span<const Judged> observations,
              const EngineOptions& options, const std::function<void(QuantizeProgress)>& report)
      : to_(std::move(to)), observations_(observations), options_(options), report_(report) {
    made_.bundle = from;
  }

  Status smooth_channels(Rounding codes) {
    const std::string to = to_ + ".smoothed";
    VLA_TRY(Smoothed smoothed, smooth(made_.bundle, to, observations_, options_));
    expected_ = std::move(smoothed.chunks);
    VLA_TRY(const Moved before, moved_by(made_.bundle, codes));
    VLA_TRY(const Moved after, moved_by(to, codes));
    tell(fmt::format("{} channels of {} norms and MLPs divided, by {:g} at most; {} moves", smoothed.n_channel,
                     smoothed.n_place, smoothed.largest, name_of(codes)),
         "smoothed", before, after);
    keep(made_.bundle, to, before, after);
    if (codes == Rounding::int4) int4_moves_ = after.rms < before.rms ? after : before;
    return {};
  }

  Status round_by_hessians() {
    const std::string to = to_ + ".int4";
    if (expected_.empty()) {
      EngineOptions float32 = options_;
      float32.kernels = "float32";
      VLA_TRY(expected_, chunks_of(made_.bundle, float32, observations_));
    }
    VLA_TRY(Hessians hessians, Hessians::of(made_.bundle, observations_, options_));
    const Int4Codes codes = {
        [&](const Bundle& bundle, const TensorInfo& tensor) { return hessians.feedback(bundle, tensor); }};
    if (const auto made = quantize(made_.bundle, to, all_as(Rounding::int4), {}, report_, codes); !made)
      return made.error();
    if (!int4_moves_) {
      VLA_TRY(int4_moves_, moved_by(made_.bundle, Rounding::int4));
    }
    const Moved before = *int4_moves_;
    VLA_TRY(const Chunks chunks, chunks_of(to, options_, observations_));
    const Moved after = moved(expected_, chunks);
    tell(fmt::format("errors of {} of {} matrices made good by later columns (GPTQ); int4 moves", hessians.n_known(),
                     hessians.n_asked()),
         "rounded by Hessians", before, after);
    keep(made_.int4, to, before, after);
    return {};
  }

  Calibrated take() { return std::move(made_); }

 private:
  static void drop(const std::string& file) {
    std::error_code ignored;
    std::filesystem::remove(file, ignored);
  }

  /// How far one kind of codes alone moves the chunks.
  Result<Moved> moved_by(const std::string& bundle, Rounding codes) {
    const std::string trial = to_ + ".trial";
    if (const auto made = quantize(bundle, trial, all_as(codes), {}, [](QuantizeProgress) {}); !made)
      return made.error();
    VLA_TRY(const Chunks chunks, chunks_of(trial, options_, observations_));
    return moved(expected_, chunks);
  }

  void tell(const std::string& done, const char* name, const Moved& before, const Moved& after) {
    const bool helps = after.rms < before.rms;
    const std::string line =
        fmt::format("{}{} over {} observations: {} chunks by {:.3f} % instead of {:.3f} %", helps ? "" : "not ", name,
                    observations_.size(), done, 100 * after.rms, 100 * before.rms);
    made_.told.push_back(line);
    if (helps) made_.why += (made_.why.empty() ? "" : "; ") + line;
  }

  static void keep(std::string& kept, const std::string& file, const Moved& before, const Moved& after) {
    if (after.rms < before.rms)
      kept = file;
    else
      drop(file);
  }

  const std::string to_;
  const std::span<const Judged> observations_;
  const EngineOptions& options_;
  const std::function<void(QuantizeProgress)>& report_;
  Chunks expected_;                  // in float32
  std::optional<Moved> int4_moves_;  // by the plain int4 codes of `made_.bundle`
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
  if (has_int4) VLA_CHECK(calibration.round_by_hessians());
  return calibration.take();
}

}  // namespace vla
