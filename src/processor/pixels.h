// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <functional>
#include <memory>
#include <span>

namespace vla {

/// The pixels of an observation, in memory that a device may provide. Refilling reuses the memory.
class Pixels {
 public:
  /// Allocates `n` floats. If it returns null, the heap is used.
  using Source = std::function<std::shared_ptr<float[]>(std::size_t n)>;

  /// Sets the source of all further allocations.
  void take_from(Source source) { source_ = std::move(source); }
  /// The values are unspecified afterwards.
  void resize(std::size_t n) {
    if (n > capacity_) {
      memory_ = source_ ? source_(n) : nullptr;
      if (!memory_) memory_ = std::shared_ptr<float[]>(new float[n]());
      capacity_ = n;
    }
    size_ = n;
  }
  void assign(std::span<const float> values) {
    resize(values.size());
    std::copy(values.begin(), values.end(), data());
  }

  float* data() { return memory_.get(); }
  const float* data() const { return memory_.get(); }
  std::size_t size() const { return size_; }
  bool empty() const { return size_ == 0; }
  float* begin() { return data(); }
  float* end() { return data() + size_; }
  const float* begin() const { return data(); }
  const float* end() const { return data() + size_; }
  float operator[](std::size_t i) const { return data()[i]; }
  float front() const { return data()[0]; }
  float back() const { return data()[size_ - 1]; }
  bool operator==(std::span<const float> other) const { return std::equal(begin(), end(), other.begin(), other.end()); }

  Pixels() = default;
  Pixels(Pixels&&) = default;
  Pixels& operator=(Pixels&&) = default;

 private:
  Source source_;
  std::shared_ptr<float[]> memory_;
  std::size_t size_ = 0, capacity_ = 0;
};

}  // namespace vla
