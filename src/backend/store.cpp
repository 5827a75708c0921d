// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "backend/store.h"

#include <algorithm>

#include "backend/pages.h"

namespace vla {

std::int64_t Tensor::dim(int i) const { return node_->ne[i]; }
std::vector<std::int64_t> Tensor::shape() const { return {node_->ne, node_->ne + ggml_n_dims(node_)}; }

MappedStore::MappedStore(std::size_t capacity)
    : context_(ggml_init({.mem_size = capacity * ggml_tensor_overhead(), .mem_buffer = nullptr, .no_alloc = true})) {}

Tensor MappedStore::add(ggml_type type, std::span<const std::int64_t> shape, const std::byte* data) {
  ggml_tensor* tensor = ggml_new_tensor(context_.get(), type, static_cast<int>(shape.size()), shape.data());
  tensor->data = const_cast<std::byte*>(data);  // a tensor without a buffer: ggml's allocator leaves it alone
  return tensor;
}

bool MappedStore::holds(Tensor tensor) { return tensor.node()->buffer == nullptr; }

Store::Store(std::size_t capacity)
    : context_(ggml_init({.mem_size = capacity * ggml_tensor_overhead(), .mem_buffer = nullptr, .no_alloc = true})) {}

Tensor Store::add(ggml_type type, std::span<const std::int64_t> shape) {
  return ggml_new_tensor(context_.get(), type, static_cast<int>(shape.size()), shape.data());
}

Tensor Store::add_like(Tensor other) { return add(other.node()->type, other.node()->ne); }

Tensor Store::add_bytes(ggml_type type, std::initializer_list<std::int64_t> shape, std::span<const std::byte> bytes) {
  const Tensor tensor = add(type, {shape.begin(), shape.size()});
  pending_.push_back({tensor, {bytes.begin(), bytes.end()}});
  return tensor;
}

Tensor Store::add_constant(std::vector<float> values, std::initializer_list<std::int64_t> shape) {
  return add_bytes(GGML_TYPE_F32, shape, std::as_bytes(std::span(values)));
}

Tensor Store::add_constant(std::vector<std::int32_t> values, std::initializer_list<std::int64_t> shape) {
  return add_bytes(GGML_TYPE_I32, shape, std::as_bytes(std::span(values)));
}

Status Store::allocate(const Device& device) {
  if (ggml_get_first_tensor(context_.get()) == nullptr) return {};
  buffer_.reset(ggml_backend_alloc_ctx_tensors(context_.get(), device.backend()));
  if (!buffer_)
    return Error{Code::out_of_memory, "buffer", "", "the device refused the allocation",
                 "free memory or use a smaller model"};
  want_large_pages(ggml_backend_buffer_get_base(buffer_.get()), size());
  for (const Pending& pending : pending_) set(pending.tensor, pending.bytes.data(), pending.bytes.size());
  pending_.clear();
  return {};
}

std::size_t Store::size() const { return buffer_ ? ggml_backend_buffer_get_size(buffer_.get()) : 0; }

void Store::set(Tensor tensor, const void* data, std::size_t size) {
  ggml_backend_tensor_set(tensor.node(), data, 0, size);
}
std::vector<float> Store::get(Tensor tensor) {
  std::vector<float> values(static_cast<std::size_t>(ggml_nelements(tensor.node())));
  ggml_backend_tensor_get(tensor.node(), values.data(), 0, values.size() * sizeof(float));
  return values;
}

}  // namespace vla
