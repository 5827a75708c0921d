// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/calibrate.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <filesystem>

#include "quantize/hessians.h"
#include "quantize/product_errors.h"
#include "quantize/rotation.h"

namespace vla {
namespace {

const char* name_of(Rounding codes) { return codes == Rounding::int4 ? "int4" : "int8"; }

/// A bundle that may be quantized, its codes, and how far they move the actions.
struct Candidate {
  std::string bundle;
  std::string files;  // prefix of the names of its files
  std::string codes = {};
  bool by_hessians = false;  // whether `codes` are by Hessians: better than plain codes
  Moved moved = {};
  std::string told = {};  // report line about Hessians
};

/// Observations in two parts. Candidates get codes by the Hessians of the first part and are compared by the second:
/// Hessians fit what they are measured by, so that would not tell which candidate is better. Fewer than four
/// observations are in both parts.
class Parts {
 public:
  explicit Parts(std::vector<Judged> observations) {
    const std::size_t n = observations.size();
    n_first_ = n < 4 ? n : (n + 1) / 2;
    for (const std::size_t first : {0, 1})
      for (std::size_t i = first; i < n; i += 2) all_.push_back(std::move(observations[i]));
  }
  std::span<const Judged> all() const { return all_; }
  std::span<const Judged> first() const { return std::span(all_).first(n_first_); }
  std::span<const Judged> second() const { return n_first_ == all_.size() ? all() : all().subspan(n_first_); }

 private:
  std::vector<Judged> all_;
  std::size_t n_first_;
};

/// The steps of `calibrate` and their common state.
class Calibration {
 public:
  Calibration(const std::string& from, const std::string& to, Parts&& observations, const EngineOptions& options,
              const std::function<void(QuantizeProgress)>& report)
      : from_(from),
        to_(to),
        observations_(std::move(observations)),
        options_(options),
        report_(report),
        kept_{from, to} {}

  /// Makes codes of three bundles and keeps the one whose codes move the chunks least: the given bundle, one with every
  /// outlier channel divided, and one with these channels divided only in places where that helps by itself. Each
  /// bundle is judged with its better codes, plain or by Hessians, because Hessians compensate different errors in
  /// each.
  Status smooth_channels(Rounding codes) {
    VLA_TRY(Smoothing found, find_smoothing(from_, observations_.all(), options_));
    expected_.assign(found.chunks.end() - std::ssize(observations_.second()), found.chunks.end());
    VLA_CHECK(make_codes(kept_, codes));
    const Moved before = kept_.moved;
    Moved after = before;
    std::vector<Scaling> taken = std::move(found.scalings);
    if (!taken.empty()) {
      Candidate all = {.bundle = to_ + ".smoothed", .files = to_ + ".smoothed"};
      VLA_CHECK(write_smoothed(from_, all.bundle, taken));
      VLA_CHECK(make_codes(all, codes));
      VLA_TRY(std::vector<Scaling> helpful,
              helpful_scalings(from_, {kept_.codes, all.codes}, codes, taken, observations_.second(), options_));
      after = all.moved;
      keep_better(std::move(all));
      if (!helpful.empty() && helpful.size() < taken.size()) {
        Candidate some = {.bundle = to_ + ".some", .files = to_ + ".some"};
        VLA_CHECK(write_smoothed(from_, some.bundle, helpful));
        VLA_CHECK(make_codes(some, codes));
        if (some.moved.rms < after.rms) after = some.moved, taken = std::move(helpful);
        keep_better(std::move(some));
      }
    }
    take(line_of(text_of(taken, found.n_place) + name_of(codes) + " moves", "smoothed", before, after),
         after.rms < before.rms);
    return {};
  }

  /// Makes codes by Hessians for the kept bundle.
  Status round_kept_by_hessians(Rounding codes) {
    if (expected_.empty()) {
      EngineOptions float32 = options_;
      float32.kernels = "float32";
      VLA_TRY(expected_, chunks_of(kept_.bundle, float32, observations_.second()));
    }
    return make_codes(kept_, codes);
  }

  /// Rotates the channels of one residual stream after the other, and the values of all attention heads, in the kept
  /// bundle, each only if its codes then move the chunks less.
  Status rotate_channels(Rounding codes) {
    VLA_TRY(const Rotations found, find_rotations(kept_.bundle, options_));
    if (found.empty()) return {};
    const Moved before = kept_.moved;
    std::vector<std::string> tried, taken;
    for (const auto& [name, rotations] : found) {
      const std::string to = to_ + (kept_.files == to_ + ".rotated" ? ".rotated2" : ".rotated");
      Candidate rotated = {.bundle = to, .files = to};
      VLA_CHECK(write_rotated(kept_.bundle, to, rotations));
      VLA_CHECK(make_codes(rotated, codes));
      tried.push_back(name);
      if (is_clearly_better(rotated.moved, kept_.moved)) {
        taken.push_back(name);
        std::swap(rotated, kept_);
      }
      drop(std::move(rotated));
    }
    const std::string names = fmt::format("channels of {}; ", fmt::join(taken.empty() ? tried : taken, ", "));
    take(line_of(names + name_of(codes) + " moves", "rotated", before, kept_.moved), !taken.empty());
    return {};
  }

  /// Adds codes of the kept bundle to the result, by the Hessians of all observations, if Hessians helped. Else deletes
  /// the codes.
  Status keep_codes(Rounding codes) {
    take(kept_.told, kept_.by_hessians);
    if (!kept_.by_hessians) {
      drop(kept_.codes);
      return {};
    }
    made_.codes.push_back(kept_.codes);
    if (observations_.first().size() == observations_.all().size()) return {};
    VLA_TRY(Hessians hessians, Hessians::of(kept_.bundle, observations_.all(), options_));
    VLA_TRY(const auto rows, quantize(kept_.bundle, kept_.codes, all_as(codes), {}, report_, source_of(hessians)));
    return {};
  }

  Calibrated result() {
    made_.bundle = kept_.bundle;
    return std::move(made_);
  }

 private:
  static void drop(const std::string& file) {
    std::error_code ignored;
    std::filesystem::remove(file, ignored);
  }
  void drop(Candidate&& candidate) {
    drop(candidate.codes);
    if (candidate.bundle != from_) drop(candidate.bundle);
  }
  void keep_better(Candidate&& candidate) {
    if (candidate.moved.rms < kept_.moved.rms) std::swap(candidate, kept_);
    drop(std::move(candidate));
  }
  /// Whether rotated channels move the chunks less, and the median one too: one observation that is about to close a
  /// gripper may decide the first, and a small gain is chance.
  static bool is_clearly_better(const Moved& got, const Moved& than) {
    constexpr double kMost = 0.95;
    return got.rms < kMost * than.rms && got.median < kMost * than.median;
  }

  /// Makes plain codes and codes by Hessians, and keeps those that move the chunks less.
  Status make_codes(Candidate& candidate, Rounding codes) {
    candidate.codes = candidate.files + ".codes";
    VLA_TRY(candidate.moved, moved_by(candidate.bundle, candidate.codes, codes, {}));
    const std::string to = candidate.files + "." + name_of(codes);
    VLA_TRY(Hessians hessians, Hessians::of(candidate.bundle, observations_.first(), options_));
    VLA_TRY(const Moved after, moved_by(candidate.bundle, to, codes, source_of(hessians)));
    candidate.told = line_of(fmt::format("errors of {} of {} matrices made good by later columns (GPTQ); {} moves",
                                         hessians.n_known(), hessians.n_asked(), name_of(codes)),
                             "rounded by Hessians", candidate.moved, after);
    candidate.by_hessians = after.rms < candidate.moved.rms;
    if (!candidate.by_hessians) {
      drop(to);
      return {};
    }
    drop(candidate.codes);
    candidate.moved = after, candidate.codes = to;
    return {};
  }

  static CodeSource source_of(Hessians& hessians) {
    return {[&](const Bundle& bundle, const TensorInfo& tensor) { return hessians.feedback(bundle, tensor); }};
  }

  /// Writes codes of all matrices and returns how far they move the chunks.
  Result<Moved> moved_by(const std::string& bundle, const std::string& to, Rounding codes, const CodeSource& source) {
    const auto report = source.feedback ? report_ : [](QuantizeProgress) {};  // plain codes take only moments
    if (const auto made = quantize(bundle, to, all_as(codes), {}, report, source); !made) return made.error();
    VLA_TRY(const Chunks chunks, chunks_of(to, options_, observations_.second()));
    return moved(expected_, chunks);
  }

  static std::string text_of(std::span<const Scaling> scalings, int n_place) {
    std::ptrdiff_t n_channel = 0;
    float largest = 1;
    for (const Scaling& scaling : scalings) {
      n_channel += std::ranges::count_if(scaling.by, [](float by) { return by != 1; });
      largest = std::max(largest, std::ranges::max(scaling.by));
    }
    return fmt::format("{} channels of {} of {} norms and MLPs divided, by {:g} at most; ", n_channel, scalings.size(),
                       n_place, largest);
  }
  std::string line_of(const std::string& done, const char* name, const Moved& before, const Moved& after) const {
    return fmt::format("{}{} over {} observations: {} chunks of {} of them by {:.3f} % instead of {:.3f} %",
                       after.rms < before.rms ? "" : "not ", name, observations_.all().size(), done,
                       observations_.second().size(), 100 * after.rms, 100 * before.rms);
  }
  void take(const std::string& line, bool helps) {
    made_.told.push_back(line);
    if (helps) made_.why += (made_.why.empty() ? "" : "; ") + line;
  }

  const std::string from_, to_;
  const Parts observations_;
  const EngineOptions& options_;
  const std::function<void(QuantizeProgress)>& report_;
  Chunks expected_;  // float32 chunks of the observations that judge
  Candidate kept_;
  Calibrated made_;
};

}  // namespace

Result<Calibrated> calibrate(const std::string& from, const std::string& to, Rounding codes, bool has_int4,
                             std::vector<Judged> observations, const EngineOptions& options,
                             const std::function<void(QuantizeProgress)>& report) {
  Calibration calibration(from, to, Parts(std::move(observations)), options, report);
  const Status smoothed = calibration.smooth_channels(codes);
  const bool has_no_place = !smoothed && smoothed.error().code == Code::unsupported;
  VLA_CHECK(has_no_place ? calibration.round_kept_by_hessians(codes) : smoothed);
  VLA_CHECK(calibration.rotate_channels(codes));
  VLA_CHECK(calibration.keep_codes(codes));
  if (has_int4 && codes != Rounding::int4) {
    VLA_CHECK(calibration.round_kept_by_hessians(Rounding::int4));
    VLA_CHECK(calibration.keep_codes(Rounding::int4));
  }
  return calibration.result();
}

}  // namespace vla
