// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu_weights.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <cstring>
#include <map>

#include "kernels/executor.h"
#include "lower/precision.h"

namespace vla {

Isa isa_for(const ParamList& list, Isa isa) {
  bool has_matrix = false;
  for (const Param& param : list.params())
    if (param.storage == Storage::matrix) {  // products of ternary ones are the same on all machines
      has_matrix = true;
      if (param.type() != DType::bf16) return without_rounding(isa);
    }
  return has_matrix ? isa : without_rounding(isa);
}

Isa attention_isa_for(const ParamList& list, Isa isa) {
  for (const Param& param : list.params())
    if (param.storage == Storage::ternary) return without_rounding(isa);
  return isa_for(list, isa);
}

namespace lower {
namespace {

kernels::MatrixDesc desc_of(const Param& param) {
  return {param.type(), param.shape[0], param.shape[1], param.storage == Storage::ternary};
}

/// Packs parameter `item`, and gives its pages of the file back, so that file and weights do not stand in memory
/// together.
struct PackTask : kernels::Task {
  struct Copy {
    const Param* param;
    const kernels::LinearKernel* kernel;
    std::byte* to;
  };
  std::vector<Copy> copies;
  const Bundle* bundle;

  void run(std::int64_t item, kernels::Worker&) const override {
    const auto& [param, kernel, to] = copies[static_cast<std::size_t>(item)];
    const std::span<const std::byte> from = param->source->data;
    if (kernel != nullptr)
      kernel->pack(desc_of(*param), from.data(), to);
    else
      std::memcpy(to, from.data(), from.size());
    bundle->release_pages(from);
  }
};

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

Result<CpuWeights> CpuWeights::load(const ParamList& list, Isa isa, int n_thread, bool fill) {
  CpuWeights weights;
  std::map<std::string, std::map<std::string, int>> counts;
  std::vector<std::size_t> offsets;
  std::size_t size = 0;
  for (const Param& param : list.params()) {
    Place place;
    offsets.push_back(size);
    if (param.is_matrix()) {
      place.kernel = kernels::choose_linear(desc_of(param), isa);
      ++counts[place.kernel->name][param.storage == Storage::ternary ? "ternary" : dtype_name(param.type())];
      size += aligned(place.kernel->packed_size(desc_of(param)));
    } else if (param.storage == Storage::vector) {
      size += aligned(static_cast<std::size_t>(param.count()) * sizeof(float));
    } else if (param.source != nullptr) {
      place.data = param.source->data.data();
      weights.table_size_ += param.source->data.size();
    }
    weights.places_.push_back(place);
  }
  VLA_TRY(weights.memory_, Memory::allocate(size, "weights"));
  weights.text_ = describe(counts);
  if (list.bundle() != nullptr) weights.file_ = list.bundle()->mapping();
  PackTask task;
  task.bundle = list.bundle();
  for (const Param& param : list.params()) {
    Place& place = weights.places_[static_cast<std::size_t>(param.id)];
    if (param.storage == Storage::table) {
      if (fill) list.bundle()->keep_pages(param.source->data);
      continue;
    }
    std::byte* to = weights.memory_.data() + offsets[static_cast<std::size_t>(param.id)];
    place.data = to;
    task.copies.push_back({&param, place.kernel, to});
  }
  if (!fill || task.copies.empty()) return weights;
  task.n_item = static_cast<std::int64_t>(task.copies.size());
  VLA_TRY(const std::shared_ptr<kernels::Executor> executor, kernels::Executor::shared(n_thread));
  const kernels::Phase phase = {{&task}, nullptr};
  executor->run({&phase, 1});
  return weights;
}

}  // namespace lower
}  // namespace vla
