// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <deque>
#include <map>

#include "lower/cpu/emit.h"
#include "lower/host/segments.h"

namespace vla::lower {

/// Phases for the executor, and the memory that they work in.
class CpuProgram final : public Program {
 public:
  /// The last pass: addresses and tasks. Errors: out_of_memory.
  static Result<std::unique_ptr<Program>> make(CpuLowering& l, const Memory& arena,
                                               std::shared_ptr<kernels::Executor> executor,
                                               std::shared_ptr<kernels::KindClock> clock);

  Status prepare() override;
  Status run() override;
  const std::vector<Stage>& stages() const override { return stages_; }
  std::vector<Work> work() const override { return work_; }
  /// From one phase of each kind, which is run for the purpose: what is in memory is lost, so of a program that was
  /// lowered for its sizes alone. Reading the weights from memory is counted on top.
  std::vector<Prediction> predictions() const override;
  const std::vector<Tap>& taps() const override { return taps_; }
  std::vector<float> tap(std::size_t i) const override;
  std::string text() const override { return text_; }
  /// The matrices that each phase reads: first those of `prepare`, then those of `run`.
  const MatrixReads& reads() const { return reads_; }
  std::size_t n_prepare() const { return n_prepare_; }
  std::size_t size() const override { return own_.size() + host_size_; }

 private:
  struct TapPlace {
    const float* data;
    Shape shape, stride;
  };
  Status run(const std::vector<Segment>& segments);
  void run_phases(std::size_t begin, std::size_t end);
  void bind() const;
  Status give_addresses(CpuLowering& l);
  Status make_tasks(const CpuLowering& l);
  Status cut(const CpuWeights& weights);
  void make_taps(const CpuLowering& l);
  std::vector<double> seconds_of_kinds() const;

  std::shared_ptr<kernels::Executor> executor_;
  std::shared_ptr<kernels::KindClock> clock_;
  std::shared_ptr<const Tables> tables_;
  Memory arena_, own_;  // own: constants, and what prepare leaves
  std::shared_ptr<const WeightTable> weights_;
  std::vector<MatrixUses> uses_;  // of each phase
  MatrixReads reads_;
  mutable std::uint64_t bound_ = 0;  // the version of the table that tasks know
  std::vector<std::unique_ptr<kernels::Task>> tasks_;
  std::vector<kernels::Phase> phases_;
  /// What a prediction has to know of each phase.
  struct Counted {
    int kind = 0;           // the same number for phases that take the same time, in the order in which they come first
    std::size_t entry = 0;  // of `predictions`
    double weights = 0;     // bytes
  };
  std::vector<Counted> counted_;
  std::vector<Segment> prepare_, run_;
  std::shared_ptr<WeightStream> stream_;  // null where all matrices are resident
  std::size_t n_prepare_ = 0, host_size_ = 0;
  std::vector<Stage> stages_;
  std::vector<Work> work_;
  std::vector<Tap> taps_;
  std::vector<TapPlace> tap_places_;
  TapVisitor see_tap_;                                                 // is shown the taps in their place
  std::multimap<std::size_t, std::pair<std::string, TapPlace>> seen_;  // by the phase behind which they are there
  std::string text_;
};

}  // namespace vla::lower
