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

  /// From now on nothing is allocated: tensors get a place that must not be read, and sizes are exact.
  void set_dry() { dry_ = true; }
  bool is_dry() const { return dry_; }

  /// Gives every tensor of the context its place, until the last copy of `*holder` is gone. Returns bytes.
  /// Errors: out_of_memory, unsupported where a tensor is larger than a buffer may be.
  Result<std::size_t> place(ggml_context* tensors, const char* what, std::shared_ptr<void>* holder);
  /// Errors: out_of_memory where the device has less than that left.
  Status check_free(std::size_t size, const char* what) const;
  /// That the device refused what it seemed to have.
  Error refused(std::size_t size, const char* what) const;
  ggml_backend_buffer_type_t type() const { return type_; }

 private:
  using Buffers = std::vector<ggml_backend_buffer_ptr>;
  struct Part {
    std::size_t size = 0;
    std::vector<ggml_tensor*> tensors;
  };
  Error refused(const Part& part, const char* what) const;
  std::vector<Part> cut(ggml_context* tensors) const;
  ggml_backend_buffer_t take(std::size_t size) const;

  std::string name_;
  ggml_backend_buffer_type_t type_;
  ggml_backend_dev_t device_;
  std::shared_ptr<Buffers> kept_;
  bool dry_ = false;
};

}  // namespace vla
