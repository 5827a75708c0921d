// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <deque>
#include <map>

#include "lower/cpu/emit.h"
#include "lower/host/segments.h"

namespace vla::lower {

/// The phases that the executor runs, and their memory.
class CpuProgram final : public Program {
 public:
  /// The last pass: assigns addresses and makes tasks. Errors: out_of_memory.
  static Result<std::unique_ptr<Program>> make(CpuLowering& l, const Memory& arena,
                                               std::shared_ptr<kernels::Executor> executor,
                                               std::shared_ptr<kernels::KindClock> clock);

  Status prepare() override { return run(prepare_); }
  Status run() override { return run(run_); }
  const std::vector<Stage>& stages() const override { return stages_; }
  std::vector<Work> work() const override { return work_; }
  /// Times one phase of each kind, predicts the run from these times and adds the time to read the weights from memory.
  /// Overwrites the program's memory, so call it only for a program that was lowered to get its sizes.
  std::vector<Prediction> predictions() const override;
  const std::vector<Tap>& taps() const override { return taps_; }
  std::vector<float> tap(std::size_t i) const override;
  std::string text() const override { return text_; }
  /// Returns the matrices that each phase reads: the phases of `prepare`, then those of `run`.
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
  Memory arena_, own_;  // own: constants, and the results of prepare
  std::shared_ptr<const WeightTable> weights_;
  std::vector<MatrixUses> uses_;  // by phase
  MatrixReads reads_;
  mutable std::uint64_t bound_ = 0;  // version of the address table that was last copied into the tasks
  std::vector<std::unique_ptr<kernels::Task>> tasks_;
  std::vector<kernels::Phase> phases_;
  /// The properties of a phase that a prediction uses.
  struct Counted {
    int kind = 0;           // phases of equal duration share a number, given in order of first appearance
    std::size_t entry = 0;  // index into `predictions`
    double weights = 0;     // bytes
  };
  std::vector<Counted> counted_;
  std::vector<Segment> prepare_, run_;
  std::shared_ptr<WeightStream> stream_;  // null if all matrices are resident
  std::size_t n_prepare_ = 0, host_size_ = 0;
  std::vector<Stage> stages_;
  std::vector<Work> work_;
  std::vector<Tap> taps_;
  std::vector<TapPlace> tap_places_;
  TapVisitor see_tap_;                                                 // receives tapped values during a run
  std::multimap<std::size_t, std::pair<std::string, TapPlace>> seen_;  // tapped values by the phase that makes them
  std::string text_;
};

}  // namespace vla::lower
