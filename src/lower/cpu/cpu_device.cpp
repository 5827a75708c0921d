// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/cpu_device.h"

#include <fmt/format.h>

#include <algorithm>
#include <cstring>
#include <limits>

#include "kernels/attention_kernel.h"
#include "kernels/pages.h"
#include "lower/cpu/cpu_program.h"
#include "lower/host/weight_plan.h"

namespace vla::lower {
namespace {

/// More keys than attention can have, so that attention never rounds.
constexpr std::int64_t kNoKeys = std::numeric_limits<std::int64_t>::max();

Multiplier multiplier_of(const CpuWeights& weights, const Param& matrix) {
  const kernels::LinearKernel& kernel = *weights.kernel(&matrix);
  return {&kernel, kernel.max_norm, kernel.takes_windows, kernel.takes_windows, &weights.encoding(&matrix)};
}

/// Checks the head width and the number of key segments against the attention kernels' limits. Errors: unsupported,
/// internal.
Status check_attention(const Graph& graph) {
  for (const Node& node : graph.nodes()) {
    const auto* attention = node.as<op::Attention>();
    if (attention == nullptr) continue;
    if (node.in[0].dim(0) > kernels::kMaxHead)
      return Error{Code::unsupported, "attention", fmt::format("heads of at most {} numbers", kernels::kMaxHead),
                   std::to_string(node.in[0].dim(0)), "use --kernels ggml"};
    const std::size_t n_segment = (node.in.size() - (attention->has_mask ? 2 : 1)) / 2;
    if (n_segment > kernels::AttentionJob::kMaxSegment)
      return Error{Code::internal, "attention", "fewer segments of keys", std::to_string(n_segment),
                   "please report this"};
  }
  return {};
}

}  // namespace

Result<std::unique_ptr<Device>> CpuDevice::open(int n_thread, const Arithmetic& arithmetic) {
  std::unique_ptr<CpuDevice> device(new CpuDevice(arithmetic));
  VLA_TRY(device->executor_, kernels::Executor::shared(n_thread));
  return std::unique_ptr<Device>(std::move(device));
}

std::string CpuDevice::name() const { return fmt::format("cpu, {} thread{}", n_thread(), n_thread() == 1 ? "" : "s"); }

Status CpuDevice::load(const ParamList& params, bool fill, const WeightPlan& plan) {
  min_rounded_keys_ = min_rounded_keys(params);
  arithmetic_.use = features_for(params, arithmetic_.use, arithmetic_.at_load);
  VLA_TRY(weights_, CpuWeights::load(params, {arithmetic_.use, arithmetic_.at_load, n_thread(), fill}, plan));
  return {};
}

Result<WeightPlan> CpuDevice::plan_weights(const Program& prefix, const Program& step, std::size_t size) const {
  const auto &first = static_cast<const CpuProgram&>(prefix), &then = static_cast<const CpuProgram&>(step);
  const auto size_of = [&](const Param& matrix) { return weights_.size_of(matrix); };
  return plan_streams({first.reads(), then.reads(), first.n_prepare(), size_of, weights_.size()}, size);
}

Status CpuDevice::allocate(Slots& slots) {
  std::size_t size = 0;
  for (const Slot& slot : slots.all()) size += aligned(slot.size());
  VLA_TRY(const Memory memory, Memory::allocate(size, "inputs and cache"));
  std::byte* place = memory.data();
  for (Slot& slot : slots.all()) slot.place = place, place += aligned(slot.size());
  want_memory_now(memory.data(), size);
  slots.hold(memory.shared(), size);
  return {};
}

void CpuDevice::set(const Slot& slot, const void* data, std::size_t size) { std::memcpy(slot.place, data, size); }
void CpuDevice::get(const Slot& slot, void* data, std::size_t size) const { std::memcpy(data, slot.place, size); }

Result<std::unique_ptr<Program>> CpuDevice::lower(const Graph& graph, const LowerOptions& options) {
  if (!graph.problem().empty())
    return Error{Code::internal, "graph", "operands that fit", graph.problem(), "please report this"};
  VLA_CHECK(check_attention(graph));
  const Target target = {.multiplier = [this](const Param& matrix) { return multiplier_of(weights_, matrix); },
                         .norm_needs = Needs::unit_rows,
                         .max_products = kernels::LinearJob::kMaxPart,
                         .min_rounded_keys = rounds_to_bf16(arithmetic_.use) ? min_rounded_keys_ : kNoKeys,
                         .keeps_taps = !options.see_tap,
                         .alignment = kAlignment,
                         .groups = weights_.groups()};
  CpuLowering l = {{.graph = graph, .options = options, .target = target}, weights_, arithmetic_.use, n_thread()};
  start(l);
  std::vector<FusedOp> ops = fuse(l);
  store(l, ops);
  choose_layouts(l, std::move(ops));
  choose_blocks(l);
  arrange(l, l.ops);
  if (l.arena_size > arena_.size()) {
    // Earlier programs keep their own arena.
    VLA_TRY(arena_, Memory::allocate(l.arena_size, "working memory"));
  }
  return CpuProgram::make(l, arena_, executor_, clock_);
}

void CpuDevice::count_times(bool on) {
  for (auto& time : clock_->nanoseconds) time = on ? 0 : time.load();
  clock_->runs = on;
}

std::vector<std::pair<std::string, double>> CpuDevice::times() const {
  std::vector<std::pair<std::string, double>> times;
  for (std::size_t i = 0; i < kernels::KindClock::count; ++i)
    times.emplace_back(kernels::KindClock::kNames[i], 1e-9 * static_cast<double>(clock_->nanoseconds[i].load()));
  return times;
}

void CpuDevice::touch() {
  if (arena_.size() > 0) want_memory_now(arena_.data(), arena_.size());
  executor_->touch();
}

}  // namespace vla::lower
