// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "base/result.h"

namespace vla {

/// A reusable buffer for parts of a file.
class ReadBuffer {
 public:
  /// At least `size` bytes, at a multiple of 64. Throws std::bad_alloc.
  std::byte* take(std::size_t size) {
    if (size > lines_.size() * sizeof(Line)) lines_.resize((size + sizeof(Line) - 1) / sizeof(Line));
    return lines_.empty() ? nullptr : lines_.front().bytes;
  }

 private:
  struct alignas(64) Line {
    std::byte bytes[64];
  };
  std::vector<Line> lines_;
};

/// The bytes of a bundle: memory that the caller owns, or a file that is read part by part.
///
/// Another process may write to the file meanwhile. `seal` therefore reads the file once and keeps a checksum of every
/// block. Later reads are compared with these checksums, so the bytes returned are those that the bundle's own checksum
/// covers, or the read is refused.
class Content {
 public:
  static constexpr std::size_t kBlock = 4096;

  explicit Content(std::span<const std::byte> memory) : bytes_(memory), shown_(memory.size()) {}
  /// Errors: io, bad_bundle (empty file), out_of_memory (address space).
  static Result<std::shared_ptr<Content>> open(const std::string& path);
  Content(const Content&) = delete;
  Content& operator=(const Content&) = delete;
  ~Content();

  /// All bytes. If they come from a file, only the part that `show` has read may be accessed; the rest is reserved
  /// address space.
  std::span<const std::byte> bytes() const { return bytes_; }
  /// Reads at least the first `n` bytes of a file. Errors: io, bad_bundle, out_of_memory.
  Status show(std::size_t n);
  std::span<const std::byte> shown() const { return bytes_.first(shown_); }

  /// Calls `see` with each part of the file in order, then releases what `show` read. Errors: io, bad_bundle.
  Status seal(const std::function<void(std::span<const std::byte>)>& see);

  /// Bytes per second that `seal` read and hashed; 0 for memory.
  double read_rate() const { return read_rate_; }
  /// Returns a part of `bytes()`. Bytes of a file are read into `buffer`; null if the file has changed. Allocates
  /// nothing once `buffer` holds buffer_size(part.size()) bytes. Several threads may call it at once, each with its own
  /// buffer.
  const std::byte* read(std::span<const std::byte> part, ReadBuffer& buffer) const;
  static constexpr std::size_t buffer_size(std::size_t size) { return (size / kBlock + 2) * kBlock; }
  /// Has the system read a part of the file ahead, without waiting for it.
  void expect(std::span<const std::byte> part) const;
  /// Tells the system that a part of the file is not read again soon, so it may drop it from the page cache.
  void forget(std::span<const std::byte> part) const;
  /// Bytes of the file in the page cache, which the system frees when memory is short; 0 for memory.
  std::size_t n_cached() const;
  /// The error to report after `read` returned null.
  Error changed() const;

 private:
  Content(int file, std::string path) : file_(file), path_(std::move(path)) {}
  Status fill(std::size_t offset, std::span<std::byte> to) const;
  void advise(std::span<const std::byte> part, int advice) const;

  int file_ = -1;
  std::string path_;
  std::span<const std::byte> bytes_;
  std::size_t shown_ = 0;
  double read_rate_ = 0;
  std::vector<std::uint64_t> sums_;  // checksums of the file's blocks
};

}  // namespace vla
