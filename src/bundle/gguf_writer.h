// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <span>
#include <string>
#include <string_view>

#include "bundle/bundle.h"

struct XXH3_state_s;

namespace vla {

/// Tensors start at multiples of this many bytes, the format's default.
inline constexpr std::size_t kGgufAlignment = 32;

/// Everything in a GGUF file before the first tensor's data. Uses only the sizes of the tensors' data.
std::string write_gguf_head(const Keys& keys, std::span<const TensorInfo> tensors);

/// The bytes of a GGUF file, version 3, which `read_gguf` reads back. Keys and tensors keep their order.
std::string write_gguf(const Keys& keys, std::span<const TensorInfo> tensors);

/// The placeholder for `vla.checksum` until all bytes are known.
inline constexpr std::string_view kNoChecksum = "xxh3:0000000000000000";

/// Writes a bundle and its checksum to an open file: first the head, then the data of each tensor in order.
class BundleFile {
 public:
  /// `vla.checksum` in `keys` must be kNoChecksum. Uses only the sizes of the tensors' data.
  BundleFile(int file, const Keys& keys, std::span<const TensorInfo> tensors);
  ~BundleFile();

  void put(std::span<const std::byte> bytes);
  /// Copies a tensor of another bundle in parts and calls `see` with the size of each. Errors: bad_bundle if that
  /// bundle's file has changed since it was opened.
  Status copy(const Bundle& bundle, const TensorInfo& tensor, const std::function<void(std::size_t)>& see);
  /// Appends zeros by extending the file, without writing them.
  void put_zeros(std::size_t size);
  /// Ends a tensor: call it after its last byte.
  void end_tensor();
  /// Writes the checksum into the head. False with errno set if any write failed.
  bool seal();

 private:
  int file_;
  bool failed_ = false;
  int errno_ = 0;
  std::size_t size_ = 0, digits_ = 0;  // bytes written so far; position of the checksum's digits
  std::unique_ptr<XXH3_state_s, int (*)(XXH3_state_s*)> state_;
  ReadBuffer buffer_;
};

}  // namespace vla
