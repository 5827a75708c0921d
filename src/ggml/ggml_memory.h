// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml-cpp.h>

#include <memory>
#include <vector>

#include "base/result.h"

namespace vla {

/// A context for `n` tensors without memory. Errors: out_of_memory.
Result<ggml_context_ptr> make_context(std::size_t n, std::size_t extra = 0);

/// Memory of one backend. What is given back is kept for the next who asks: with drivers that were seen to corrupt
/// their heap when buffers come and go (Mesa's lavapipe 22.3), plans may still be built and dropped.
class GgmlMemory {
 public:
  /// `device` is null for the CPU, whose memory nobody counts beforehand.
  GgmlMemory(std::string name, ggml_backend_buffer_type_t type, ggml_backend_dev_t device)
      : name_(std::move(name)), type_(type), device_(device), kept_(std::make_shared<Buffers>()) {}

  /// While it is dry nothing is allocated: tensors get a place that must not be read, and sizes are exact.
  void set_dry(bool dry) { dry_ = dry, kept_ = std::make_shared<Buffers>(); }
  bool is_dry() const { return dry_; }

  /// Bytes that were given back.
  std::size_t idle_size() const;

  /// Gives every tensor of the context its place, until the last copy of `*holder` is gone. Returns bytes.
  /// Errors: out_of_memory, unsupported where a tensor is larger than a buffer may be.
  Result<std::size_t> place(ggml_context* tensors, const char* what, std::shared_ptr<void>* holder);
  /// Gives a tensor a place in another one that has its own. Errors: device.
  Status place_inside(const ggml_tensor& larger, std::size_t offset, ggml_tensor* tensor) const;
  /// Bytes from the place of a tensor to that of the next.
  std::size_t size_of(const ggml_tensor* tensor) const;
  /// Errors: out_of_memory where the device has less than that left.
  Status check_free(std::size_t size, const char* what) const;
  /// That the device refused what it seemed to have.
  Error refused(std::size_t size, const char* what) const;
  ggml_backend_buffer_type_t type() const { return type_; }

 private:
  struct Buffer {
    std::size_t size;
    ggml_backend_buffer_ptr memory;  // null of a dry one
  };
  using Buffers = std::vector<Buffer>;
  struct Part {
    std::size_t size = 0;
    std::vector<ggml_tensor*> tensors;
  };
  Error refused(const Part& part, const char* what) const;
  std::vector<Part> cut(ggml_context* tensors) const;
  Buffer take(std::size_t size) const;

  std::string name_;
  ggml_backend_buffer_type_t type_;
  ggml_backend_dev_t device_;
  std::shared_ptr<Buffers> kept_;
  bool dry_ = false;
};

}  // namespace vla
