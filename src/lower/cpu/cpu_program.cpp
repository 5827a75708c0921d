// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/cpu_program.h"

#include <algorithm>
#include <cstring>
#include <map>

#include "lower/cpu/emit.h"

namespace vla::lower {
namespace {

/// Estimated bytes of host memory per task: the largest task, list entries and allocator overhead.
constexpr std::size_t kTaskSize = sizeof(kernels::LinearJob) + 2 * sizeof(void*) + 256;

}  // namespace

Result<std::unique_ptr<Program>> CpuProgram::make(CpuLowering& l, const Memory& arena,
                                                  std::shared_ptr<kernels::Executor> executor,
                                                  std::shared_ptr<kernels::KindClock> clock) {
  std::unique_ptr<CpuProgram> program(new CpuProgram);
  program->executor_ = std::move(executor), program->clock_ = std::move(clock);
  program->arena_ = arena, program->tables_ = l.weights.tables(), program->weights_ = l.weights.table();
  program->stream_ = l.weights.stream();
  VLA_CHECK(program->give_addresses(l));
  VLA_CHECK(program->make_tasks(l));
  VLA_CHECK(program->cut(l.weights));
  program->make_taps(l);
  return std::unique_ptr<Program>(std::move(program));
}

Status CpuProgram::give_addresses(CpuLowering& l) {
  // Small pages: a dry program writes few of its constants. With large pages the address would decide whether that
  // takes 2 MB more, and a process would not have the same size in every run.
  VLA_TRY(own_, Memory::allocate(l.kept_size, "constants", Pages::small));
  l.data = addresses_of(l, arena_.data(), own_.data(), [&](const Param& param) { return l.weights.data(&param); });
  for (std::size_t i = 0; i < l.values.size(); ++i)
    if (l.values[i].placement == Value::Placement::constant)
      std::memcpy(l.data[i], constant_of(l.values[i]), l.values[i].size);
  return {};
}

Status CpuProgram::make_tasks(const CpuLowering& l) {
  std::size_t scratch = 0;
  n_prepare_ = static_cast<std::size_t>(l.n_prepare);
  phases_.resize(static_cast<std::size_t>(l.n_phase)), uses_.resize(phases_.size()), reads_.resize(phases_.size());
  const auto& stages = l.graph.stages();
  std::vector<std::string> likeness(phases_.size());
  counted_.resize(phases_.size());
  work_.resize(stages.size() + 1);
  std::vector<std::size_t> stage_end(stages.size(), 0);  // one past the last phase of each stage
  for (const CpuOp& op : l.ops) {
    const auto phase = static_cast<std::size_t>(op.phase);
    CpuRun run = std::visit([&](const auto& what) { return run_of(l, op, what); }, op.op);
    scratch = std::max(scratch, run.scratch);
    const std::string text = text_of(l, op, run);
    uses_[phase].insert(uses_[phase].end(), run.matrices.begin(), run.matrices.end());
    if (!op.matrices.empty()) reads_[phase].push_back(op.matrices);
    tasks_.push_back(std::move(run.task));
    tasks_.back()->kind = run.kind, tasks_.back()->clock = clock_.get();
    phases_[phase].tasks.push_back(tasks_.back().get());
    text_ += text + "\n";
    const std::size_t stage = stage_of(l, op);
    const Work work = work_of(l, op);
    if (!op.invariant) work_[stage] += work;
    likeness[phase] += likeness_of(text) + "\n";
    counted_[phase].entry = op.invariant ? work_.size() : stage, counted_[phase].weights += work.weights;
    if (stage < stages.size() && !op.invariant) stage_end[stage] = std::max(stage_end[stage], phase + 1);
    host_size_ += kTaskSize;
  }
  std::map<std::string, int> kinds;
  for (std::size_t i = 0; i < phases_.size(); ++i)
    counted_[i].kind = kinds.try_emplace(likeness[i], static_cast<int>(kinds.size())).first->second;
  for (const Graph::Stage& stage : stages) stages_.push_back({stage.name, {}});
  for (std::size_t i = 0; i < stages.size(); ++i)
    if (stage_end[i] > 0) phases_[stage_end[i] - 1].done = &stages_[i].done;
  host_size_ += text_.size();
  return executor_->reserve(scratch);
}

void CpuProgram::make_taps(const CpuLowering& l) {
  see_tap_ = l.options.see_tap;
  for (const Node& node : l.graph.nodes()) {
    if (!node.tapped) continue;
    const Value& value = l.value(node.id);
    const auto* data = reinterpret_cast<const float*>(l.address(value.base)) + value.offset;
    const TapPlace place = {data, value.shape, value.stride};
    if (see_tap_)
      seen_.emplace(l.there_in(node.id), std::pair(node.path, place));
    else
      taps_.push_back({node.path, node.shape}), tap_places_.push_back(place);
  }
}

Status CpuProgram::cut(const CpuWeights& weights) {
  VLA_TRY(const std::vector<Groups> groups, find_groups(reads_, weights.groups()));
  prepare_ = cut_phases(std::span(groups).first(n_prepare_), 0);
  run_ = cut_phases(std::span(groups).subspan(n_prepare_), n_prepare_);
  return {};
}

/// Copies the matrices' current addresses from the table into the tasks.
void CpuProgram::bind() const {
  for (const MatrixUses& phase : uses_)
    for (const auto& [part, matrix] : phase) {
      const auto& [data, scales] = weights_->at(matrix);
      part->weight = data, part->scale = scales;
    }
  bound_ = weights_->version;
}

Status CpuProgram::run(const std::vector<Segment>& segments) {
  if (bound_ != weights_->version) bind();
  for (const Segment& segment : segments) {
    if (segment.groups.any()) VLA_CHECK(stream_->bring(segment.groups.first, segment.groups.last));
    run_phases(segment.begin, segment.end);
    if (segment.released >= 0) stream_->release(segment.released);
  }
  for (const auto& [param, rows] : *tables_) VLA_CHECK(rows->status());
  return {};
}

/// Pauses after each phase that makes a tapped value to report the value, since the next phase may overwrite it.
void CpuProgram::run_phases(std::size_t begin, std::size_t end) {
  for (auto next = seen_.lower_bound(begin); begin < end;) {
    const std::size_t stop = next != seen_.end() ? std::min(end, next->first + 1) : end;
    executor_->run(std::span(phases_).subspan(begin, stop - begin));
    for (; next != seen_.end() && next->first < stop; ++next) {
      const auto& [path, place] = next->second;
      if (is_contiguous(place.shape, place.stride))
        see_tap_(path, place.shape, {place.data, static_cast<std::size_t>(count(place.shape))});
      else
        see_tap_(path, place.shape, contiguous(place.data, place.shape, place.stride));
    }
    begin = stop;
  }
}

std::vector<float> CpuProgram::tap(std::size_t i) const {
  const auto& [data, shape, stride] = tap_places_[i];
  return contiguous(data, shape, stride);
}

}  // namespace vla::lower
