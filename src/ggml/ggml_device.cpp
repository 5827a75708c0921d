// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "ggml/ggml_device.h"

#include <fmt/format.h>
#include <ggml-cpu.h>

#include <vector>

#include "ggml/ggml_program.h"

namespace vla {
namespace {

ggml_type type_of(DType type) {
  switch (type) {
    case DType::bf16:
      return GGML_TYPE_BF16;
    case DType::f16:
      return GGML_TYPE_F16;
    case DType::i32:
      return GGML_TYPE_I32;
    case DType::i8:
      return GGML_TYPE_I8;
    case DType::f64:  // of statistics alone, which no graph reads
    case DType::f32:
      break;
  }
  return GGML_TYPE_F32;
}

/// ggml's products of bf16 and f16 would round the activations first, so that matrices are widened. Rows of a table are
/// widened exactly when they are looked up.
ggml_type resident_type(const Param& param) {
  return param.storage == Storage::table && param.source != nullptr ? type_of(param.source->type) : GGML_TYPE_F32;
}

void upload(ggml_tensor* tensor, const Param& param, const std::byte* data) {
  if (type_of(param.source->type) == tensor->type)
    return ggml_backend_tensor_set(tensor, data, 0, param.source->data.size());
  std::vector<float> values(static_cast<std::size_t>(param.count()));
  if (param.storage == Storage::ternary)
    for (std::size_t i = 0; i < values.size(); ++i)
      values[i] = static_cast<float>(std::to_integer<int>(data[i / 4]) >> 2 * (i % 4) & 3) - 1.0f;
  else if (param.source->type == DType::bf16)
    ggml_bf16_to_fp32_row(reinterpret_cast<const ggml_bf16_t*>(data), values.data(), param.count());
  else
    ggml_fp16_to_fp32_row(reinterpret_cast<const ggml_fp16_t*>(data), values.data(), param.count());
  ggml_backend_tensor_set(tensor, values.data(), 0, values.size() * sizeof(float));
}

Error refused(const char* what) {
  return {Code::out_of_memory, what, "", "the device refused the allocation", "free memory or use a smaller model"};
}

}  // namespace

Result<ggml_context_ptr> make_context(std::size_t n, std::size_t extra) {
  ggml_context_ptr context(
      ggml_init({.mem_size = n * ggml_tensor_overhead() + extra, .mem_buffer = nullptr, .no_alloc = true}));
  if (context) return context;
  return refused("graph");
}

void GgmlDevice::FreePool::operator()(ggml_threadpool* pool) const { ggml_threadpool_free(pool); }

Result<std::unique_ptr<Device>> GgmlDevice::cpu(int n_thread) {
  ggml_log_set([](ggml_log_level, const char*, void*) {}, nullptr);  // failures become an Error instead
  auto device = std::make_unique<GgmlDevice>();
  device->n_thread_ = n_thread;
  device->backend_.reset(ggml_backend_cpu_init());
  if (!device->backend_) return Error{Code::device, "cpu", "a backend", "the system refused it"};
  ggml_threadpool_params params = ggml_threadpool_params_default(n_thread);
  params.poll = 0;  // between two runs its threads sleep
  device->pool_.reset(ggml_threadpool_new(&params));
  ggml_backend_cpu_set_threadpool(device->backend_.get(), device->pool_.get());
  ggml_backend_cpu_set_n_threads(device->backend_.get(), n_thread);
  return std::unique_ptr<Device>(std::move(device));
}

std::string GgmlDevice::name() const { return fmt::format("cpu, {} thread{}", n_thread_, n_thread_ == 1 ? "" : "s"); }

Status GgmlDevice::load(const ParamList& params, bool fill) {
  VLA_TRY(weight_context_, make_context(params.params().size()));
  int n_matrix = 0;
  for (const Param& param : params.params()) {
    n_matrix += param.is_matrix() ? 1 : 0;
    weights_.push_back(ggml_new_tensor(weight_context_.get(), resident_type(param),
                                       static_cast<int>(param.shape.size()), param.shape.data()));
  }
  text_ = n_matrix > 0 ? fmt::format("ggml ({} f32)", n_matrix) : "";
  if (weights_.empty()) return {};
  weight_buffer_.reset(ggml_backend_alloc_ctx_tensors(weight_context_.get(), backend_.get()));
  if (!weight_buffer_) return refused("weights");
  Room room;
  for (const Param& param : params.params()) {
    if (!fill) break;
    VLA_TRY(const auto data, params.bundle()->read(param.source->data, room));
    upload(weight(&param), param, data.data());
  }
  return {};
}

Status GgmlDevice::allocate(Slots& slots) {
  struct Memory {
    ggml_context_ptr context;
    ggml_backend_buffer_ptr buffer;
  };
  if (slots.all().empty()) return {};
  auto memory = std::make_shared<Memory>();
  VLA_TRY(memory->context, make_context(slots.all().size()));
  for (Slot& slot : slots.all())
    slot.place = ggml_new_tensor(memory->context.get(), type_of(slot.type), 4, slot.shape.data());
  memory->buffer.reset(ggml_backend_alloc_ctx_tensors(memory->context.get(), backend_.get()));
  if (!memory->buffer) return refused("inputs and cache");
  ggml_backend_buffer_clear(memory->buffer.get(), 0);
  slots.hold(memory, ggml_backend_buffer_get_size(memory->buffer.get()));
  return {};
}

void GgmlDevice::set(const Slot& slot, const void* data, std::size_t size) {
  ggml_backend_tensor_set(static_cast<ggml_tensor*>(slot.place), data, 0, size);
}
void GgmlDevice::get(const Slot& slot, void* data, std::size_t size) const {
  ggml_backend_tensor_get(static_cast<const ggml_tensor*>(slot.place), data, 0, size);
}

Result<std::unique_ptr<Program>> GgmlDevice::lower(const Graph& graph, const LowerOptions&) {
  if (!graph.problem().empty())
    return Error{Code::internal, "graph", "operands that fit", graph.problem(), "please report this"};
  return GgmlProgram::make(graph, *this);
}

std::size_t GgmlDevice::weights_size() const {
  return weight_buffer_ ? ggml_backend_buffer_get_size(weight_buffer_.get()) : 0;
}

}  // namespace vla
