// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <memory>
#include <span>
#include <string>
#include <string_view>
#include <unordered_map>
#include <vector>

#include "base/result.h"
#include "bundle/keys.h"

namespace vla {

enum class DType { f32, f16, bf16, i32, i8, f64 };

const char* dtype_name(DType type);
std::size_t dtype_size(DType type);

/// A tensor as stored in the file. `shape` follows ggml: fastest dimension first.
struct TensorInfo {
  std::string name;
  DType type;
  std::vector<std::int64_t> shape;
  std::span<const std::byte> data;

  std::int64_t count() const;
};

/// An opened, fully checked GGUF file: see docs/bundle.md. Every length in it was compared with the file's size before
/// it was used, so that a truncated or hostile file is refused instead of read.
class Bundle {
 public:
  /// How a file comes into memory. A copy is what its checksum says, whatever happens to the file afterwards. A mapping
  /// takes no memory of the process, but who changes the file changes what it holds, and who makes it shorter ends the
  /// process (SIGBUS).
  enum class Access { copy, map };

  /// Reads or maps the file, parses it, and compares checksum and version. Errors: io, bad_bundle, out_of_memory.
  static Result<Bundle> open(const std::string& path, Access access = Access::copy);
  /// The same on bytes in memory, which must outlive the bundle.
  static Result<Bundle> parse(std::span<const std::byte> bytes, std::string name);

  const std::string& path() const { return path_; }
  const Keys& keys() const { return keys_; }
  const std::vector<TensorInfo>& tensors() const { return tensors_; }
  const TensorInfo* find(std::string_view name) const;
  /// A one- or two-dimensional f32 or f64 tensor of finite values, for statistics: row by row. Errors: bad_bundle.
  Result<std::vector<double>> stats(std::string_view name) const;
  std::size_t file_size() const { return bytes_.size(); }
  /// Gives whole pages of a part of an opened file back to the system, because they are not read any more: of a copy
  /// they are gone, and touching them ends the process.
  void release_pages(std::span<const std::byte> part) const;
  /// Reads a part of a mapped file into memory now, instead of page by page when it is used.
  void keep_pages(std::span<const std::byte> part) const;
  /// Keeps an opened file's bytes where they are for as long as somebody holds this; null for bytes of `parse`.
  const std::shared_ptr<const void>& mapping() const { return mapping_; }

 private:
  std::string path_;
  Access access_ = Access::map;
  std::shared_ptr<const void> mapping_;
  std::span<const std::byte> bytes_;
  Keys keys_;
  std::vector<TensorInfo> tensors_;
  std::unordered_map<std::string, std::size_t> index_;  // of tensors_, by name
};

}  // namespace vla
