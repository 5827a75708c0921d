// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <memory>
#include <new>
#include <optional>
#include <span>

namespace vla::net {

/// Bytes of a fixed number, left as the system gave them: a page takes memory only once something was written to it.
class Bytes {
 public:
  Bytes() = default;
  /// None where there is no memory.
  static std::optional<Bytes> make(std::size_t size) noexcept {
    Bytes bytes;
    bytes.data_.reset(new (std::nothrow) std::byte[size]);
    bytes.size_ = size;
    return bytes.data_ ? std::optional<Bytes>(std::move(bytes)) : std::nullopt;
  }

  std::size_t size() const { return size_; }
  std::span<std::byte> span() { return {data_.get() + begin_, size_}; }
  std::span<const std::byte> span() const { return {data_.get() + begin_, size_}; }
  /// Keeps a part of them, in place.
  void narrow(std::size_t begin, std::size_t size) {
    begin_ += begin;
    size_ = size;
  }

 private:
  std::unique_ptr<std::byte[]> data_;
  std::size_t begin_ = 0, size_ = 0;
};

}  // namespace vla::net
