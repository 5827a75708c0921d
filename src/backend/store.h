// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml-cpp.h>

#include <cstddef>
#include <initializer_list>
#include <span>
#include <vector>

#include "backend/device.h"
#include "backend/tensor.h"
#include "base/result.h"

namespace vla {

/// Tensors over memory that belongs to somebody else, which must outlive them; nothing writes to it.
class MappedStore {
 public:
  explicit MappedStore(std::size_t capacity);
  Tensor add(ggml_type type, std::span<const std::int64_t> shape, const std::byte* data);
  static bool holds(Tensor tensor);

 private:
  ggml_context_ptr context_;
};

/// Tensors that outlive the graphs which use them: weights, tables, inputs, the cache. First all are declared, then
/// `allocate` gives them one buffer, then values are set.
class Store {
 public:
  explicit Store(std::size_t capacity);

  /// Shapes follow ggml, fastest first, one to four dimensions.
  Tensor add(ggml_type type, std::span<const std::int64_t> shape);
  Tensor add_f32(std::initializer_list<std::int64_t> shape) {
    return add(GGML_TYPE_F32, {shape.begin(), shape.size()});
  }
  Tensor add_i32(std::initializer_list<std::int64_t> shape) {
    return add(GGML_TYPE_I32, {shape.begin(), shape.size()});
  }
  Tensor add_like(Tensor other);
  /// An f32 or i32 tensor with fixed values, which `allocate` uploads.
  Tensor add_constant(std::vector<float> values, std::initializer_list<std::int64_t> shape);
  Tensor add_constant(std::vector<std::int32_t> values, std::initializer_list<std::int64_t> shape);

  Status allocate(const Device& device);
  std::size_t size() const;

  static void set(Tensor tensor, const void* data, std::size_t size);
  /// All values of an f32 tensor.
  static std::vector<float> get(Tensor tensor);

 private:
  struct Pending {
    Tensor tensor;
    std::vector<std::byte> bytes;
  };
  Tensor add_bytes(ggml_type type, std::initializer_list<std::int64_t> shape, std::span<const std::byte> bytes);

  ggml_context_ptr context_;
  ggml_backend_buffer_ptr buffer_;
  std::vector<Pending> pending_;
};

}  // namespace vla
