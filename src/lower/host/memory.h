// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <memory>
#include <string>

#include "base/result.h"

namespace vla::lower {

/// Everything that kernels read starts at such a multiple.
constexpr std::size_t kAlignment = 64;
constexpr std::size_t aligned(std::size_t size) { return (size + kAlignment - 1) / kAlignment * kAlignment; }

/// Memory from the system, zeros until it is written, whose pages come when they are touched.
class Memory {
 public:
  Memory() = default;
  /// `what` is for the error. Errors: out_of_memory.
  static Result<Memory> allocate(std::size_t size, const std::string& what);
  /// Addresses that nobody may write, also of more than the system has. They read as zeros, which take no memory.
  static Result<Memory> reserve(std::size_t size, const std::string& what);

  std::byte* data() const { return data_.get(); }
  std::size_t size() const { return size_; }
  const std::shared_ptr<std::byte>& shared() const { return data_; }

 private:
  static Result<Memory> map(std::size_t size, const std::string& what, int protection, int flags);

  std::shared_ptr<std::byte> data_;
  std::size_t size_ = 0;
};

}  // namespace vla::lower
