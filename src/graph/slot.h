// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <deque>
#include <memory>
#include <string>
#include <vector>

#include "bundle/bundle.h"

namespace vla {

/// Sizes, fastest dimension first; missing dimensions are 1.
using Shape = std::array<std::int64_t, 4>;

constexpr std::int64_t count(const Shape& shape) { return shape[0] * shape[1] * shape[2] * shape[3]; }
/// "[720, 50]": all dimensions up to the last that is not 1.
std::string shape_text(const Shape& shape);
/// The same sizes as a vector.
std::vector<std::int64_t> dims(const Shape& shape);

/// A tensor that outlives the graphs that read and write it: inputs, the cache, x, tables made at load. Float32 or i32.
struct Slot {
  DType type = DType::f32;
  Shape shape = {1, 1, 1, 1};
  void* place = nullptr;  // the slot's address on the device; null until its memory is allocated

  std::size_t size() const { return static_cast<std::size_t>(count(shape)) * 4; }
};

/// Slots that share one allocation: declare all of them first, then call Device::allocate.
class Slots {
 public:
  Slot* add(DType type, const Shape& shape) { return &slots_.emplace_back(Slot{type, shape, nullptr}); }
  Slot* add_f32(const Shape& shape) { return add(DType::f32, shape); }
  Slot* add_i32(const Shape& shape) { return add(DType::i32, shape); }

  std::deque<Slot>& all() { return slots_; }
  /// Size in bytes of the memory that holds the slots.
  std::size_t size() const { return size_; }
  /// Takes ownership of the memory that holds the slots, `size` bytes.
  void hold(std::shared_ptr<void> memory, std::size_t size) { memory_ = std::move(memory), size_ = size; }

 private:
  std::deque<Slot> slots_;  // a deque: graphs keep pointers to them
  std::shared_ptr<void> memory_;
  std::size_t size_ = 0;
};

}  // namespace vla
