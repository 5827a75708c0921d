// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu_weights.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <atomic>
#include <cstring>
#include <map>

#include "kernels/executor.h"
#include "kernels/quantize_weights.h"
#include "kernels/sizes.h"

namespace vla::lower {
namespace {

/// The matrix as it is multiplied.
kernels::MatrixDesc desc_of(const Param& param, DType type) {
  return {type, param.shape[0], param.shape[1], param.storage == Storage::ternary};
}

/// Ternary matrices have one scale, which is a parameter.
bool has_scales(const Param& param, DType type) { return type == DType::i8 && param.storage == Storage::matrix; }

void round_to_bf16(DType type, const std::byte* stored, std::int64_t n, std::byte* to) {
  for (std::int64_t i = 0; i < n; ++i) {
    const std::uint16_t rounded = to_bf16(kernels::stored_number(type, stored, i));
    std::memcpy(to + static_cast<std::int64_t>(sizeof(rounded)) * i, &rounded, sizeof(rounded));
  }
}

/// Rows of a matrix in a part that is read and packed at a time: whole panels of every kernel.
constexpr std::int64_t kPartRows = 64;
/// Bytes of a part, at least; a worker has one in memory.
constexpr std::int64_t kPartSize = 1 << 20;

/// Parts of parameters from the bundle's file to their places, so that no more than a part for each worker stands in
/// memory twice.
struct PackTask : kernels::Task {
  struct Part {
    kernels::MatrixDesc desc;
    std::span<const std::byte> from;
    const kernels::LinearKernel* kernel;  // null: a copy
    std::byte* to;
    DType stored = DType::f32;
    float* scales = nullptr;  // of int8
    bool is_rounded() const { return kernel != nullptr && desc.type != stored; }
  };
  const Bundle* bundle;
  std::vector<Part> parts;
  mutable std::vector<Room> rooms, rounded;  // of each worker
  mutable std::atomic<bool> has_failed = false;

  void add(const Param& param, DType type, const kernels::LinearKernel* kernel, std::byte* to, float* scales) {
    const std::span<const std::byte> all = param.source->data;
    if (kernel == nullptr) return parts.push_back({{}, all, nullptr, to});
    kernels::MatrixDesc desc = desc_of(param, type);
    const std::int64_t n_row = desc.d_out, row = static_cast<std::int64_t>(all.size()) / n_row;
    const std::int64_t step = kernels::round_up(kPartSize / row + 1, kPartRows);
    for (std::int64_t first = 0; first < n_row; first += step) {
      desc.d_out = first;
      std::byte* const place = to + kernel->packed_size(desc);
      desc.d_out = std::min(step, n_row - first);
      parts.push_back({desc,
                       all.subspan(static_cast<std::size_t>(first * row), static_cast<std::size_t>(desc.d_out * row)),
                       kernel, place, param.type(), scales != nullptr ? scales + first : nullptr});
    }
  }

  void run(std::int64_t item, kernels::Worker& worker) const override {
    const Part& part = parts[static_cast<std::size_t>(item)];
    const auto& [desc, from, kernel, to, stored, scales] = part;
    const auto i = static_cast<std::size_t>(worker.index);
    const std::byte* read = bundle->content()->read(from, rooms[i]);
    if (read == nullptr) {
      has_failed = true;
    } else if (part.is_rounded()) {
      std::byte* const numbers = rounded[i].take(rounded_size(desc) + row_size(desc));
      auto* const row = reinterpret_cast<float*>(numbers + rounded_size(desc));
      if (scales != nullptr)
        kernels::quantize_weights(stored, read, desc.d_in, desc.d_out, numbers, scales, row);
      else
        round_to_bf16(stored, read, desc.d_in * desc.d_out, numbers);
      kernel->pack(desc, numbers, to);
    } else if (kernel != nullptr) {
      kernel->pack(desc, read, to);
    } else {
      std::memcpy(to, read, from.size());
    }
  }

  static std::size_t rounded_size(const kernels::MatrixDesc& desc) {
    return aligned(static_cast<std::size_t>(desc.d_in * desc.d_out) * dtype_size(desc.type));
  }
  static std::size_t row_size(const kernels::MatrixDesc& desc) {
    return static_cast<std::size_t>(desc.d_in) * sizeof(float);
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

Result<CpuWeights> CpuWeights::load(const ParamList& list, const Options& options) {
  VLA_CHECK(check_rounding(list, options.rounding));
  CpuWeights weights;
  std::map<std::string, std::map<std::string, int>> counts;
  std::vector<std::size_t> offsets;
  const auto tables = std::make_shared<Tables>();
  weights.tables_ = tables;
  std::size_t size = 0;
  for (const Param& param : list.params()) {
    Place place;
    offsets.push_back(size);
    if (param.is_matrix()) {
      place.type = resident_dtype(param, options.rounding);
      const kernels::MatrixDesc desc = desc_of(param, place.type);
      place.kernel = kernels::choose_linear(desc, options.use);
      ++counts[place.kernel->name][param.storage == Storage::ternary ? "ternary" : dtype_name(param.type())];
      size += aligned(place.kernel->packed_size(desc));
      if (has_scales(param, place.type)) size += aligned(static_cast<std::size_t>(desc.d_out) * sizeof(float));
    } else if (param.storage == Storage::vector) {
      size += aligned(static_cast<std::size_t>(param.count()) * sizeof(float));
    } else if (param.source != nullptr) {
      VLA_TRY(std::unique_ptr<TableRows> rows, TableRows::make(*list.bundle(), param));
      weights.table_size_ += rows->size();
      tables->emplace(&param, std::move(rows));
    }
    weights.places_.push_back(place);
  }
  VLA_TRY(weights.memory_, Memory::allocate(size, "weights"));
  weights.text_ = describe(counts);
  PackTask task;
  task.bundle = list.bundle();
  for (const Param& param : list.params()) {
    if (param.storage == Storage::table) continue;
    Place& place = weights.places_[static_cast<std::size_t>(param.id)];
    place.data = weights.memory_.data() + offsets[static_cast<std::size_t>(param.id)];
    if (has_scales(param, place.type))
      place.scales =
          reinterpret_cast<float*>(place.data + aligned(place.kernel->packed_size(desc_of(param, place.type))));
    if (options.fill) task.add(param, place.type, place.kernel, place.data, place.scales);
  }
  if (task.parts.empty()) return weights;
  VLA_TRY(const std::shared_ptr<kernels::Executor> executor, kernels::Executor::shared(options.n_thread));
  task.rooms.resize(static_cast<std::size_t>(executor->n_thread()));
  task.rounded.resize(task.rooms.size());
  for (const PackTask::Part& part : task.parts)  // a worker must not run out of memory
    for (std::size_t i = 0; i < task.rooms.size(); ++i) {
      task.rooms[i].take(Content::room_for(part.from.size()));
      if (part.is_rounded()) task.rounded[i].take(PackTask::rounded_size(part.desc) + PackTask::row_size(part.desc));
    }
  task.n_item = static_cast<std::int64_t>(task.parts.size());
  const kernels::Phase phase = {{&task}, nullptr};
  executor->run({&phase, 1});
  if (task.has_failed) return list.bundle()->content()->changed();
  return weights;
}

}  // namespace vla::lower
