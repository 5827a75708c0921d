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

/// Memory of one backend. Returned buffers are kept and reused, since plans come and go: Mesa's lavapipe 22.3 was seen
/// to corrupt its heap when buffers are freed and allocated again.
class GgmlMemory {
 public:
  /// `device` is null for the CPU, whose free memory is not checked before an allocation.
  GgmlMemory(std::string name, ggml_backend_buffer_type_t type, ggml_backend_dev_t device)
      : name_(std::move(name)), type_(type), device_(device), kept_(std::make_shared<Buffers>()) {}

  /// In dry mode nothing is allocated: tensors get an address that must not be read, and sizes are exact.
  void set_dry(bool dry) { dry_ = dry, kept_ = std::make_shared<Buffers>(); }
  bool is_dry() const { return dry_; }

  /// Bytes in returned buffers.
  std::size_t idle_size() const;

  /// Allocates memory for every tensor of the context, until the last copy of `*holder` is gone. Returns its bytes.
  /// Errors: out_of_memory; unsupported if a tensor exceeds the largest buffer.
  Result<std::size_t> place(ggml_context* tensors, const char* what, std::shared_ptr<void>* holder);
  /// Places a tensor inside another one's memory. Errors: device.
  Status place_inside(const ggml_tensor& larger, std::size_t offset, ggml_tensor* tensor) const;
  /// Bytes from one tensor's place to the next.
  std::size_t size_of(const ggml_tensor* tensor) const;
  /// Errors: out_of_memory if less than `size` bytes of the device are free.
  Status check_free(std::size_t size, const char* what) const;
  /// The error if the device refuses memory that it reported as free.
  Error refused(std::size_t size, const char* what) const;
  ggml_backend_buffer_type_t type() const { return type_; }

 private:
  struct Buffer {
    std::size_t size;
    ggml_backend_buffer_ptr memory;  // null in dry mode
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
