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

/// Tensors start at multiples of this many bytes, the format's own default.
inline constexpr std::size_t kGgufAlignment = 32;

/// Everything of a GGUF file before the first tensor's bytes. Only the sizes of the tensors' data are used.
std::string write_gguf_head(const Keys& keys, std::span<const TensorInfo> tensors);

/// The bytes of a GGUF file, version 3, that `read_gguf` reads back: keys in their order, then tensors in theirs.
std::string write_gguf(const Keys& keys, std::span<const TensorInfo> tensors);

/// The value of `vla.checksum` before the bytes are known.
inline constexpr std::string_view kNoChecksum = "xxh3:0000000000000000";

/// A bundle that grows in an open file, with its checksum: first the head, then the bytes of one tensor after the
/// other.
class BundleFile {
 public:
  /// `vla.checksum` of the keys must be kNoChecksum. Of the tensors' data only the sizes are used.
  BundleFile(int file, const Keys& keys, std::span<const TensorInfo> tensors);
  ~BundleFile();

  void put(std::span<const std::byte> bytes);
  /// A tensor of a bundle as it is; `see` is told the bytes of every part. Errors: bad_bundle where the bundle's file
  /// has been changed since it was opened.
  Status copy(const Bundle& bundle, const TensorInfo& tensor, const std::function<void(std::size_t)>& see);
  /// So many zeros, which take no place on the way.
  void put_zeros(std::size_t size);
  /// After the last byte of a tensor.
  void end_tensor();
  /// Writes the checksum into the head. False with errno set if anything could not be written.
  bool seal();

 private:
  int file_;
  bool failed_ = false;
  int errno_ = 0;
  std::size_t size_ = 0, digits_ = 0;  // bytes written, and where the checksum's digits are
  std::unique_ptr<XXH3_state_s, int (*)(XXH3_state_s*)> state_;
  ReadBuffer buffer_;
};

}  // namespace vla
