// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/cuda_program.h"

#include <algorithm>
#include <cstring>

#include "lower/cuda/emit.h"

namespace vla::lower {
Result<std::unique_ptr<Program>> CudaProgram::make(CudaLowering& l, std::shared_ptr<CudaQueue> queue,
                                                   std::vector<std::shared_ptr<cuda::Buffer>> memory,
                                                   const GpuModel* model) {
  std::unique_ptr<CudaProgram> program(new CudaProgram);
  program->queue_ = std::move(queue), program->memory_ = std::move(memory), program->windows_ = l.weights.windows();
  VLA_CHECK(program->give_addresses(l, *program->memory_.back()));
  VLA_TRY(const std::vector<int> n_launch, program->make_parts(l));
  VLA_CHECK(program->make_marks(l));
  program->make_taps(l);
  if (model != nullptr) program->predictions_ = predict(l, n_launch, *model);
  return std::unique_ptr<Program>(std::move(program));
}

Status CudaProgram::give_addresses(CudaLowering& l, const cuda::Buffer& arena) {
  VLA_TRY(own_, queue_->allocate(l.kept_size, "constants"));
  std::vector<std::byte> constants;
  std::size_t first = l.kept_size;
  for (const Value& value : l.values) {
    if (value.placement != Value::Placement::constant) continue;
    first = std::min(first, value.begin);
    constants.resize(l.kept_size - first);
    std::memcpy(&constants[value.begin - first], constant_of(value), value.size);
  }
  if (!constants.empty()) VLA_CHECK(queue_->upload(own_->address() + first, constants.data(), constants.size()));
  l.data = addresses_of(l, arena.address(), own_->address(), [&](const Param& param) { return l.weights[param].data; });
  return {};
}

CudaProgram::~CudaProgram() {
  for (const auto* pieces : {&prepare_, &run_})
    for (const Piece& piece : *pieces) queue_->forget(piece.part);
}

Status CudaProgram::run(const std::vector<Piece>& pieces) {
  for (const Piece& piece : pieces) {
    if (piece.groups.any()) {
      VLA_CHECK(queue_->flush());  // the device computes queued work while the groups are copied
      VLA_CHECK(windows_->bring(piece.groups));
    }
    VLA_CHECK(queue_->run(piece.part));
  }
  return {};
}

Result<std::vector<int>> CudaProgram::make_parts(const CudaLowering& l) {
  std::vector<int> n_launch;
  for (const Graph::Stage& stage : l.graph.stages()) stages_.push_back({stage.name, {}});
  work_.resize(stages_.size() + 1);
  n_prepare_ = static_cast<std::size_t>(l.n_prepare);
  std::vector<std::vector<Calls>> phases(static_cast<std::size_t>(l.n_phase));
  reads_.resize(phases.size());
  for (const CudaOp& op : l.ops) {
    VLA_TRY(Calls calls, std::visit([&](const auto& what) { return calls_of(l, op, what); }, op.op));
    const std::string text = std::visit([](const auto& what) { return what.text(); }, op.op) +
                             (op.rotation.table != kNone ? ", rope" : "") +
                             (op.begins.squares != kNone ? ", begins norm" : "");
    const Work work = work_of(l, op);
    if (!op.invariant) work_[stage_of(l, op)] += work;
    text_ += line_of(l, op, calls.empty() ? "nothing" : calls.front().how.kernel, text, work) + "\n";
    n_launch.push_back(static_cast<int>(calls.size()));
    const auto phase = static_cast<std::size_t>(op.phase);
    phases[phase].push_back(std::move(calls));
    if (!op.matrices.empty()) reads_[phase].push_back(op.matrices);
  }
  for (std::vector<Calls>& phase : phases) merge_calls(phase, l.n_sm);
  VLA_TRY(const std::vector<Groups> groups, find_groups(reads_, l.weights.groups()));
  prepare_ = pieces(cut_phases(std::span(groups).first(n_prepare_), 0), phases);
  run_ = pieces(cut_phases(std::span(groups).subspan(n_prepare_), n_prepare_), phases);
  if (run_.empty()) run_.emplace_back();  // marks need a piece
  return n_launch;
}

std::vector<CudaProgram::Piece> CudaProgram::pieces(const std::vector<Segment>& segments,
                                                    std::vector<std::vector<Calls>>& phases) {
  std::vector<Piece> pieces;
  for (const Segment& segment : segments) {
    Piece& piece = pieces.emplace_back();
    piece.groups = segment.groups;
    for (std::size_t i = segment.begin; i < segment.end; ++i) piece.part.phases.push_back(std::move(phases[i]));
  }
  return pieces;
}

/// Marks the end of each stage's last phase, and the end of the run.
Status CudaProgram::make_marks(const CudaLowering& l) {
  const std::size_t n_run = reads_.size() - n_prepare_;
  std::vector<std::size_t> ends(stages_.size(), 0);
  for (const CudaOp& op : l.ops)
    for (std::size_t stage = stage_of(l, op); op.phase >= l.n_prepare && stage < ends.size(); ++stage)
      ends[stage] = std::max(ends[stage], static_cast<std::size_t>(op.phase - l.n_prepare + 1));
  const auto add = [&](std::size_t n_phase, Time* time) -> Status {
    VLA_TRY(cuda::Owned event, queue_->event());
    auto piece = run_.begin();
    for (; n_phase > piece->part.phases.size(); ++piece) n_phase -= piece->part.phases.size();
    piece->part.marks.push_back({n_phase, std::move(event), time});
    return {};
  };
  for (std::size_t i = 0; i < stages_.size(); ++i) VLA_CHECK(add(ends[i], &stages_[i].done));
  return stages_.empty() ? Status() : add(n_run, &ended_);
}

std::optional<Program::Time> CudaProgram::ended() const {
  return stages_.empty() ? std::nullopt : std::optional(ended_);
}

void CudaProgram::make_taps(const CudaLowering& l) {
  for (const Node& node : l.graph.nodes()) {
    if (!node.tapped) continue;
    taps_.push_back({node.path, node.shape});
    tap_places_.push_back({l.address(node.id), l.value(node.id).shape, l.value(node.id).stride});
  }
}

std::vector<float> CudaProgram::tap(std::size_t i) const {
  const auto& [data, shape, stride] = tap_places_[i];
  std::int64_t last = 0;
  for (std::size_t d = 0; d < 4; ++d) last += (shape[d] - 1) * stride[d];
  std::vector<float> all(static_cast<std::size_t>(last + 1));
  queue_->get(all.data(), data, all.size() * sizeof(float));
  return contiguous(all.data(), shape, stride);
}

}  // namespace vla::lower
