// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/cpu_weights.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <atomic>
#include <map>

#include "kernels/executor.h"
#include "lower/host/weight_plan.h"

namespace vla::lower {
namespace {

/// The number of threads that read streamed matrices, in addition to the `n_thread` that compute.
int n_reader(int n_thread) { return std::max(1, n_thread / 4); }

std::string describe(const std::map<std::string, std::map<std::string, int>>& counts) {
  std::vector<std::string> parts;
  for (const auto& [name, types] : counts) {
    std::vector<std::string> of_type;
    for (const auto& [type, count] : types) of_type.push_back(fmt::format("{} {}", count, type));
    parts.push_back(fmt::format("{} ({})", name, fmt::join(of_type, ", ")));
  }
  return fmt::format("{}", fmt::join(parts, ", "));
}

}  // namespace

bool CpuWeights::has_int8() const {
  return std::ranges::any_of(places_, [](const Place& place) {
    return place.encoding.type == DType::i8 || place.encoding.type == DType::int4;
  });
}

Result<CpuWeights> CpuWeights::load(const ParamList& list, const Options& options, const WeightPlan& plan) {
  VLA_CHECK(check_rounding(list, options.rounding));
  CpuWeights weights;
  VLA_CHECK(weights.choose(list, options));
  VLA_CHECK(weights.give_places(list, options, plan));
  if (!options.fill) return weights;
  VLA_CHECK(weights.fill(list, plan, options.n_thread));
  VLA_CHECK(weights.start_stream(list, plan, options.n_thread));
  return weights;
}

/// Chooses the storage and the kernel of each parameter.
Status CpuWeights::choose(const ParamList& list, const Options& options) {
  std::map<std::string, std::map<std::string, int>> counts;
  const auto tables = std::make_shared<Tables>();
  tables_ = tables;
  for (const Param& param : list.params()) {
    Place& place = places_.emplace_back();
    if (param.storage == Storage::matrix) {
      place.encoding = resident_encoding(param, options.rounding);
      place.kernel = kernels::choose_linear({place.encoding.type, param.shape[0], param.shape[1]}, options.use);
      place.packing = {place.kernel->packed_size, place.kernel->pack};
      if (param.scales == nullptr) place.n_scale = place.encoding.n_scale(param.count());  // computed at load
      ++counts[place.kernel->name][dtype_name(param.encoding.type)];
    } else if (param.storage == Storage::table && param.source != nullptr) {
      VLA_TRY(std::unique_ptr<TableRows> rows, TableRows::make(*list.bundle(), param));
      table_size_ += rows->size();
      tables->emplace(&param, std::move(rows));
    }
  }
  text_ = describe(counts);
  return {};
}

/// Places resident parameters one after the other, then the windows.
Status CpuWeights::give_places(const ParamList& list, const Options& options, const WeightPlan& plan) {
  groups_ = groups_by_id(plan, places_.size());
  const auto size_in_memory = [&](const Param& param) {
    if (param.storage == Storage::matrix) return is_streamed(param) ? 0 : size_of(param);
    return param.storage == Storage::vector ? aligned(static_cast<std::size_t>(param.count()) * sizeof(float)) : 0;
  };
  std::size_t size = 0;
  for (const Param& param : list.params()) size += size_in_memory(param);
  const std::size_t windows = plan.streamed.empty() ? 0 : WeightStream::kWindows * plan.window;
  VLA_TRY(memory_,
          options.fill ? Memory::allocate(size + windows, "weights") : Memory::reserve(size + windows, "weights"));

  std::byte* next = memory_.data();
  for (const Param& param : list.params()) {
    Place& at = place(&param);
    if (at.kernel != nullptr && !is_streamed(param)) at.put(param, next);
    if (at.kernel == nullptr) at.data = next;
    next += size_in_memory(param);
  }
  for (std::size_t i = 0; i < plan.streamed.size(); ++i) {
    std::byte* to = next + static_cast<std::size_t>(WeightStream::window_of(i)) * plan.window;
    for (const Param* matrix : plan.streamed[i]) place(matrix).put(*matrix, to), to += size_of(*matrix);
  }
  table_ = std::make_shared<WeightTable>();
  for (const Param& param : list.params()) {
    const Place& at = place(&param);
    const bool has_vector = at.kernel != nullptr && param.scales != nullptr;
    table_->entries.push_back({at.data, has_vector ? reinterpret_cast<float*>(place(param.scales).data) : at.scales});
  }
  return {};
}

/// Reads and packs the resident parameters.
Status CpuWeights::fill(const ParamList& list, const WeightPlan& plan, int n_thread) const {
  std::vector<PackPart> parts;
  for (const Param& param : list.params()) {
    if (param.storage == Storage::table || is_streamed(param)) continue;
    if (param.storage == Storage::matrix)
      add_parts(param, place(&param), parts);
    else
      parts.push_back({.from = param.source->data, .to = place(&param).data});
  }
  if (parts.empty()) return {};
  const Content& content = *list.bundle()->content();
  VLA_TRY(const std::shared_ptr<kernels::Executor> executor, kernels::Executor::shared(n_thread));
  std::vector<Packer> packers(static_cast<std::size_t>(executor->n_thread()));
  for (Packer& packer : packers) packer.reserve(parts);
  std::atomic<bool> has_failed = false;
  const auto task =
      kernels::task_of(static_cast<std::int64_t>(parts.size()), [&](std::int64_t i, kernels::Worker& worker) {
        Packer& packer = packers[static_cast<std::size_t>(worker.index)];
        if (!packer.run(content, parts[static_cast<std::size_t>(i)])) has_failed = true;
      });
  const kernels::Phase phase = {{task.get()}, nullptr};
  executor->run({&phase, 1});
  if (has_failed) return content.changed();
  if (!plan.streamed.empty())  // free the page cache of bytes that are packed in memory
    for (const PackPart& part : parts) content.forget(part.from);
  return {};
}

Status CpuWeights::start_stream(const ParamList& list, const WeightPlan& plan, int n_thread) {
  if (plan.streamed.empty()) return {};
  std::vector<std::vector<PackPart>> groups;
  for (const std::vector<const Param*>& group : plan.streamed) {
    std::vector<PackPart>& parts = groups.emplace_back();
    for (const Param* matrix : group) add_parts(*matrix, place(matrix), parts);
  }
  VLA_TRY(stream_, WeightStream::start(list.bundle()->content(), std::move(groups), n_reader(n_thread)));
  return {};
}

}  // namespace vla::lower
