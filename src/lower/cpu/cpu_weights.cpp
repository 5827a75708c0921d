// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/cpu_weights.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <atomic>
#include <cstring>
#include <map>

#include "kernels/executor.h"
#include "kernels/sizes.h"
#include "lower/cpu/recode.h"

namespace vla::lower {
namespace {

/// The matrix as it is multiplied.
kernels::MatrixDesc desc_of(const Param& param, const Encoding& encoding) {
  return {encoding.type, param.shape[0], param.shape[1]};
}

/// Scales that the bundle does not have.
std::int64_t n_made_scale(const Param& param, const Encoding& encoding) {
  return param.scales == nullptr ? encoding.n_scale(param.count()) : 0;
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
    Recode recode = {};
    float* scales = nullptr;                      // where they are made
    std::span<const std::byte> from_scales = {};  // of codes that become floats
  };
  const Bundle* bundle;
  std::vector<Part> parts;
  mutable std::vector<Room> rooms, scale_rooms, recoded;  // of each worker
  mutable std::atomic<bool> has_failed = false;

  void add(const Param& param, std::byte* to) {
    parts.push_back({.desc = {}, .from = param.source->data, .kernel = nullptr, .to = to});
  }
  void add(const Param& param, const Encoding& encoding, const kernels::LinearKernel* kernel, std::byte* to,
           float* scales) {
    const std::span<const std::byte> all = param.source->data;
    kernels::MatrixDesc desc = desc_of(param, encoding);
    const std::int64_t n_row = desc.d_out, row = static_cast<std::int64_t>(all.size()) / n_row;
    const std::int64_t step = kernels::round_up(kPartSize / row + 1, kPartRows);
    for (std::int64_t first = 0; first < n_row; first += step) {
      desc.d_out = first;
      std::byte* const place = to + kernel->packed_size(desc);
      desc.d_out = std::min(step, n_row - first);
      parts.push_back(
          {.desc = desc,
           .from = all.subspan(static_cast<std::size_t>(first * row), static_cast<std::size_t>(desc.d_out * row)),
           .kernel = kernel,
           .to = place,
           .recode = {param.encoding, encoding},
           .scales = scales != nullptr ? scales + encoding.n_scale(first * desc.d_in) : nullptr,
           .from_scales = from_scales(param, encoding, first * desc.d_in, desc.d_out * desc.d_in)});
    }
  }

  /// Those of elements from `first` on, where float32 needs them.
  static std::span<const std::byte> from_scales(const Param& param, const Encoding& wanted, std::int64_t first,
                                                std::int64_t count) {
    if (wanted.type == param.encoding.type || param.scales == nullptr) return {};
    const auto size = [&](std::int64_t n) {
      return static_cast<std::size_t>(param.encoding.n_scale(n)) * sizeof(float);
    };
    return param.scales->source->data.subspan(size(first), size(count));
  }

  void run(std::int64_t item, kernels::Worker& worker) const override {
    const Part& part = parts[static_cast<std::size_t>(item)];
    const auto i = static_cast<std::size_t>(worker.index);
    const std::byte* read = bundle->content()->read(part.from, rooms[i]);
    const std::byte* scales = bundle->content()->read(part.from_scales, scale_rooms[i]);
    if (read == nullptr || (scales == nullptr && !part.from_scales.empty())) {
      has_failed = true;
    } else if (part.kernel == nullptr) {
      std::memcpy(part.to, read, part.from.size());
    } else {
      const std::int64_t count = part.desc.d_in * part.desc.d_out;
      const auto* const from_scales = reinterpret_cast<const float*>(scales);
      part.kernel->pack(part.desc, part.recode(read, from_scales, count, recoded[i], part.scales), part.to);
    }
  }

  /// Takes the memory that workers need, since they must not run out of it.
  void reserve(int n_thread) {
    rooms.resize(static_cast<std::size_t>(n_thread)), recoded.resize(rooms.size()), scale_rooms.resize(rooms.size());
    for (const Part& part : parts)
      for (std::size_t i = 0; i < rooms.size(); ++i) {
        rooms[i].take(Content::room_for(part.from.size()));
        scale_rooms[i].take(Content::room_for(part.from_scales.size()));
        if (part.recode.changes()) recoded[i].take(part.recode.room_for(part.desc.d_in * part.desc.d_out));
      }
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

bool CpuWeights::has_int8() const {
  return std::ranges::any_of(places_, [](const Place& place) {
    return place.encoding.type == DType::i8 || place.encoding.type == DType::int4;
  });
}

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
    if (param.storage == Storage::matrix) {
      place.encoding = resident_encoding(param, options.rounding);
      const kernels::MatrixDesc desc = desc_of(param, place.encoding);
      place.kernel = kernels::choose_linear(desc, options.use);
      ++counts[place.kernel->name][dtype_name(param.encoding.type)];
      size += aligned(place.kernel->packed_size(desc));
      size += aligned(static_cast<std::size_t>(n_made_scale(param, place.encoding)) * sizeof(float));
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
  weights.table_ = std::make_shared<WeightTable>();
  auto& entries = weights.table_->entries;
  for (const std::size_t offset : offsets) entries.push_back({weights.memory_.data() + offset});
  for (const Param& param : list.params()) {
    if (param.storage == Storage::table) continue;
    const auto& [encoding, kernel] = weights.place(&param);
    auto& [data, scales] = entries[static_cast<std::size_t>(param.id)];
    const bool makes_scales = n_made_scale(param, encoding) > 0;
    if (makes_scales) scales = reinterpret_cast<float*>(data + aligned(kernel->packed_size(desc_of(param, encoding))));
    if (param.scales != nullptr)
      scales = reinterpret_cast<float*>(entries[static_cast<std::size_t>(param.scales->id)].data);
    if (!options.fill) continue;
    if (kernel != nullptr)
      task.add(param, encoding, kernel, data, makes_scales ? scales : nullptr);
    else
      task.add(param, data);
  }
  if (task.parts.empty()) return weights;
  VLA_TRY(const std::shared_ptr<kernels::Executor> executor, kernels::Executor::shared(options.n_thread));
  task.reserve(executor->n_thread());
  task.n_item = static_cast<std::int64_t>(task.parts.size());
  const kernels::Phase phase = {{&task}, nullptr};
  executor->run({&phase, 1});
  if (task.has_failed) return list.bundle()->content()->changed();
  return weights;
}

}  // namespace vla::lower
