// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <memory>
#include <string>

#include "base/result.h"

namespace vla::lower {

/// Alignment of everything that kernels read, in bytes.
constexpr std::size_t kAlignment = 64;
constexpr std::size_t aligned(std::size_t size) { return (size + kAlignment - 1) / kAlignment * kAlignment; }

/// The system's pages. A large one takes 2 MB when any part of it is touched.
enum class Pages { small, large };

/// Zeroed memory from the system; pages are allocated when touched.
class Memory {
 public:
  Memory() = default;
  /// `what` names the memory in the error. Errors: out_of_memory.
  static Result<Memory> allocate(std::size_t size, const std::string& what, Pages pages = Pages::large);
  /// Reserves addresses that read as zeros, may not be written and take no memory. May exceed the system's memory.
  static Result<Memory> reserve(std::size_t size, const std::string& what);

  std::byte* data() const { return data_.get(); }
  std::size_t size() const { return size_; }
  const std::shared_ptr<std::byte>& shared() const { return data_; }

 private:
  static Result<Memory> map(std::size_t size, const std::string& what, int protection, int flags, Pages pages);

  std::shared_ptr<std::byte> data_;
  std::size_t size_ = 0;
};

}  // namespace vla::lower
