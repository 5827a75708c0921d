// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "backend/weights.h"

namespace vla {
namespace {

ggml_type resident_type(const Param& param) {
  if (param.storage != Storage::table || param.source == nullptr) return GGML_TYPE_F32;
  switch (param.source->type) {
    case DType::bf16:
      return GGML_TYPE_BF16;
    case DType::f16:
      return GGML_TYPE_F16;
    default:
      return GGML_TYPE_F32;
  }
}

void upload(Tensor tensor, const Param& param) {
  const std::span<const std::byte> data = param.source->data;
  const bool widen = tensor.node()->type == GGML_TYPE_F32 && param.source->type != DType::f32;
  if (!widen) return Store::set(tensor, data.data(), data.size());
  std::vector<float> values(static_cast<std::size_t>(param.count()));
  if (param.source->type == DType::bf16)
    ggml_bf16_to_fp32_row(reinterpret_cast<const ggml_bf16_t*>(data.data()), values.data(), param.count());
  else
    ggml_fp16_to_fp32_row(reinterpret_cast<const ggml_fp16_t*>(data.data()), values.data(), param.count());
  Store::set(tensor, values.data(), values.size() * sizeof(float));
}

}  // namespace

Result<Weights> Weights::load(const ParamList& list, const Device& device, Fill fill) {
  Weights weights(list.params().size(), device.isa());
  for (const Param& param : list.params())
    weights.tensors_.push_back(weights.store_.add(resident_type(param), param.shape));
  VLA_CHECK(weights.store_.allocate(device));
  if (fill == Fill::yes)
    for (const Param& param : list.params()) {
      upload(weights[&param], param);
      list.bundle()->release_pages(param.source->data);  // so that file and weights do not stand in memory together
    }
  return weights;
}

}  // namespace vla
