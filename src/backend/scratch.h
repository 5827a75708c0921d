// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdlib>
#include <memory>

#include "backend/pages.h"

namespace vla {

/// Memory that a thread of a running graph works in, one piece for each thread. It grows while graphs are built, never
/// while they run: nodes keep a pointer to this object and ask for their piece when they run.
class Scratch {
 public:
  explicit Scratch(int n_thread) : n_thread_(static_cast<std::size_t>(n_thread)) {}

  /// At least `size` bytes for each thread from the next run on, where the system has them: see `ok`.
  void reserve(std::size_t size) {
    if (size <= size_) return;
    size_ = (size + kAlignment - 1) / kAlignment * kAlignment;
    memory_.reset();
    memory_.reset(static_cast<std::byte*>(std::aligned_alloc(kAlignment, size_ * n_thread_)));
    if (ok()) want_large_pages(memory_.get(), this->size());
  }
  /// Whether everything that was reserved is there.
  bool ok() const { return size_ == 0 || memory_ != nullptr; }
  /// The piece of thread i, at a multiple of a page.
  std::byte* of(int i) const { return memory_.get() + static_cast<std::size_t>(i) * size_; }
  /// Bytes of all pieces.
  std::size_t size() const { return size_ * n_thread_; }

 private:
  static constexpr std::size_t kAlignment = 4096;
  struct Free {
    void operator()(std::byte* memory) const { std::free(memory); }
  };

  std::size_t n_thread_, size_ = 0;
  std::unique_ptr<std::byte, Free> memory_;
};

}  // namespace vla
