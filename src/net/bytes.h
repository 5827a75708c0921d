// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <memory>
#include <new>
#include <optional>
#include <span>

namespace vla::net {

/// A buffer of fixed size, uninitialized: a page takes memory only once it is written.
class Bytes {
 public:
  Bytes() = default;
  /// None if memory is short.
  static std::optional<Bytes> make(std::size_t size) noexcept {
    Bytes bytes;
    bytes.data_.reset(new (std::nothrow) std::byte[size]);
    bytes.size_ = size;
    return bytes.data_ ? std::optional<Bytes>(std::move(bytes)) : std::nullopt;
  }

  std::size_t size() const { return size_; }
  std::span<std::byte> span() { return {data_.get() + begin_, size_}; }
  std::span<const std::byte> span() const { return {data_.get() + begin_, size_}; }
  /// Narrows the buffer to a part of it, in place.
  void narrow(std::size_t begin, std::size_t size) {
    begin_ += begin;
    size_ = size;
  }

 private:
  std::unique_ptr<std::byte[]> data_;
  std::size_t begin_ = 0, size_ = 0;
};

}  // namespace vla::net
