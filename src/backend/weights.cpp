// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "backend/weights.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <atomic>
#include <map>
#include <thread>

namespace vla {
namespace {

ggml_type stored_type(const Param& param) {
  switch (param.source->type) {
    case DType::bf16:
      return GGML_TYPE_BF16;
    case DType::f16:
      return GGML_TYPE_F16;
    default:
      return GGML_TYPE_F32;
  }
}

MatrixDesc desc_of(const Param& param) { return {param.source->type, param.shape[0], param.shape[1]}; }

void widen(Tensor tensor, const Param& param) {
  const std::byte* data = param.source->data.data();
  if (param.source->type == DType::f32) return Store::set(tensor, data, param.source->data.size());
  std::vector<float> values(static_cast<std::size_t>(param.count()));
  if (param.source->type == DType::bf16)
    ggml_bf16_to_fp32_row(reinterpret_cast<const ggml_bf16_t*>(data), values.data(), param.count());
  else
    ggml_fp16_to_fp32_row(reinterpret_cast<const ggml_fp16_t*>(data), values.data(), param.count());
  Store::set(tensor, values.data(), values.size() * sizeof(float));
}

/// work(i) for every i in [0, n), by several threads.
template <class F>
void side_by_side(int n_thread, std::size_t n, const F& work) {
  std::atomic<std::size_t> next = 0;
  const auto take = [&] {
    for (std::size_t i; (i = next++) < n;) work(i);
  };
  std::vector<std::thread> others;
  for (int i = 1; i < n_thread; ++i) others.emplace_back(take);
  take();
  for (std::thread& other : others) other.join();
}

}  // namespace

Weights::Place Weights::declare(const Param& param, ChooseFormat choose) {
  if (param.source == nullptr) return {store_.add(GGML_TYPE_F32, param.shape), nullptr};  // sizes alone are asked for
  const bool is_matrix = param.storage == Storage::matrix;
  const MatrixFormat* format = is_matrix && choose != nullptr ? choose(desc_of(param), isa_) : nullptr;
  if (format != nullptr)
    return {store_.add(GGML_TYPE_I8, std::vector{static_cast<std::int64_t>(format->packed_size(desc_of(param)))}),
            format};
  if (param.storage == Storage::table) {
    mapped_size_ += param.source->data.size();
    return {mapped_.add(stored_type(param), param.shape, param.source->data.data()), nullptr};
  }
  return {store_.add(GGML_TYPE_F32, param.shape), nullptr};
}

Isa isa_for(const ParamList& list, Isa isa) {
  bool has_matrix = false;
  for (const Param& param : list.params())
    if (param.storage == Storage::matrix) {
      has_matrix = true;
      if (param.source == nullptr || param.source->type != DType::bf16) return without_rounding(isa);
    }
  return has_matrix ? isa : without_rounding(isa);
}

Result<Weights> Weights::load(const ParamList& list, const Device& device, Fill fill, ChooseFormat choose) {
  Weights weights(list.params().size(), device);
  weights.isa_ = isa_for(list, device.isa());
  for (const Param& param : list.params()) weights.places_.push_back(weights.declare(param, choose));
  weights.describe(list);
  VLA_CHECK(weights.store_.allocate(device));
  if (list.bundle() != nullptr) weights.file_ = list.bundle()->mapping();
  if (fill == Fill::no) return weights;
  const auto& params = list.params();
  side_by_side(device.n_thread(), params.size(), [&](std::size_t i) { weights.fill(params[i], *list.bundle()); });
  return weights;
}

void Weights::fill(const Param& param, const Bundle& bundle) const {
  const auto& [tensor, format] = places_[static_cast<std::size_t>(param.id)];
  if (MappedStore::holds(tensor)) return bundle.keep_pages(param.source->data);
  if (format != nullptr)
    format->pack(desc_of(param), param.source->data.data(), static_cast<std::byte*>(tensor.node()->data));
  else
    widen(tensor, param);
  bundle.release_pages(param.source->data);  // so that file and weights do not stand in memory together
}

void Weights::describe(const ParamList& list) {
  std::map<std::string, std::map<std::string, int>> counts;
  for (const Param& param : list.params())
    if (param.storage == Storage::matrix && param.source != nullptr) {
      const MatrixFormat* chosen = format(&param);
      ++counts[chosen != nullptr ? chosen->name : "ggml"][dtype_name(param.source->type)];
    }
  std::vector<std::string> parts;
  for (const auto& [name, types] : counts) {
    std::vector<std::string> of_type;
    for (const auto& [type, count] : types) of_type.push_back(fmt::format("{} {}", count, type));
    parts.push_back(fmt::format("{} ({})", name, fmt::join(of_type, ", ")));
  }
  kernels_ = fmt::format("{}", fmt::join(parts, ", "));
}

}  // namespace vla
