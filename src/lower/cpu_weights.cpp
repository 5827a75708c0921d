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
#include "lower/precision.h"

namespace vla {

Isa isa_for(const ParamList& list, Isa isa) {
  const auto& params = list.params();
  const auto rounds = [](const Param& param) {
    return param.storage == Storage::matrix && param.type() == DType::bf16;
  };
  return std::any_of(params.begin(), params.end(), rounds) ? isa : without_rounding(isa);
}

std::int64_t min_rounded_keys(const ParamList& list) {
  const auto& params = list.params();
  const auto is_ternary = [](const Param& param) { return param.storage == Storage::ternary; };
  return std::any_of(params.begin(), params.end(), is_ternary) ? 512 : 128;
}

namespace lower {
namespace {

/// Products from or to fewer numbers take no time worth an error. Padded states and actions of robots have up to 132
/// numbers (GR00T N1.7).
constexpr std::int64_t kMinQuantized = 144;

bool becomes_int8(const Param& param, bool quantizes) {
  return quantizes && param.storage == Storage::matrix && std::min(param.shape[0], param.shape[1]) >= kMinQuantized;
}

/// The matrix as it is multiplied.
kernels::MatrixDesc desc_of(const Param& param, bool quantizes) {
  const DType type = becomes_int8(param, quantizes) ? DType::i8 : param.type();
  return {type, param.shape[0], param.shape[1], param.storage == Storage::ternary};
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
    DType stored = DType::f32;  // of what is quantized
    float* scales = nullptr;    // where something is
  };
  const Bundle* bundle;
  std::vector<Part> parts;
  mutable std::vector<Room> rooms, codes;  // of each worker
  mutable std::atomic<bool> has_failed = false;

  void add(const Param& param, const kernels::LinearKernel* kernel, std::byte* to, float* scales) {
    const std::span<const std::byte> all = param.source->data;
    if (kernel == nullptr) return parts.push_back({{}, all, nullptr, to});
    kernels::MatrixDesc desc = desc_of(param, scales != nullptr);
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
    const auto& [desc, from, kernel, to, stored, scales] = parts[static_cast<std::size_t>(item)];
    const auto i = static_cast<std::size_t>(worker.index);
    const std::byte* read = bundle->content()->read(from, rooms[i]);
    if (read == nullptr) {
      has_failed = true;
    } else if (scales != nullptr) {
      std::byte* const quantized = codes[i].take(size_of_codes(desc) + row_size(desc));
      auto* const row = reinterpret_cast<float*>(quantized + size_of_codes(desc));
      kernels::quantize_weights(stored, read, desc.d_in, desc.d_out, quantized, scales, row);
      kernel->pack(desc, quantized, to);
    } else if (kernel != nullptr) {
      kernel->pack(desc, read, to);
    } else {
      std::memcpy(to, read, from.size());
    }
  }

  static std::size_t size_of_codes(const kernels::MatrixDesc& desc) {
    return aligned(static_cast<std::size_t>(desc.d_in * desc.d_out));
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
  const auto& all = list.params();
  if (options.quantizes &&
      std::none_of(all.begin(), all.end(), [](const Param& param) { return becomes_int8(param, true); }))
    return Error{Code::unsupported, "kernels int8", "matrices of floats that are worth quantizing", "none",
                 "leave --kernels out"};
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
      const kernels::MatrixDesc desc = desc_of(param, options.quantizes);
      place.kernel = kernels::choose_linear(desc, options.isa);
      ++counts[place.kernel->name][param.storage == Storage::ternary ? "ternary" : dtype_name(param.type())];
      size += aligned(place.kernel->packed_size(desc));
      if (becomes_int8(param, options.quantizes)) size += aligned(static_cast<std::size_t>(desc.d_out) * sizeof(float));
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
    if (becomes_int8(param, options.quantizes))
      place.scales = reinterpret_cast<float*>(place.data + aligned(place.kernel->packed_size(desc_of(param, true))));
    if (options.fill) task.add(param, place.kernel, place.data, place.scales);
  }
  if (task.parts.empty()) return weights;
  VLA_TRY(const std::shared_ptr<kernels::Executor> executor, kernels::Executor::shared(options.n_thread));
  task.rooms.resize(static_cast<std::size_t>(executor->n_thread()));
  task.codes.resize(task.rooms.size());
  for (const PackTask::Part& part : task.parts)  // a worker must not run out of memory
    for (std::size_t i = 0; i < task.rooms.size(); ++i) {
      task.rooms[i].take(Content::room_for(part.from.size()));
      if (part.scales != nullptr)
        task.codes[i].take(PackTask::size_of_codes(part.desc) + PackTask::row_size(part.desc));
    }
  task.n_item = static_cast<std::int64_t>(task.parts.size());
  const kernels::Phase phase = {{&task}, nullptr};
  executor->run({&phase, 1});
  if (task.has_failed) return list.bundle()->content()->changed();
  return weights;
}

}  // namespace lower
}  // namespace vla
