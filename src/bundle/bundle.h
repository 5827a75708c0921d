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
#include "bundle/content.h"
#include "bundle/encoding.h"
#include "bundle/keys.h"

namespace vla {

/// A tensor as stored in the file. `shape` follows ggml: fastest dimension first. Read `data` of an opened bundle with
/// Bundle::read.
struct TensorInfo {
  std::string name;
  DType type;
  std::vector<std::int64_t> shape;
  std::span<const std::byte> data;

  std::int64_t count() const;
};

/// An opened and checked GGUF file; see docs/bundle.md. Every length in it is compared with the file's size before use,
/// so a truncated or hostile file is refused.
class Bundle {
 public:
  /// Parses the file and compares checksum and version. Tensor data stay in the file. Errors: io, bad_bundle,
  /// out_of_memory.
  static Result<Bundle> open(const std::string& path);
  /// The same for bytes in memory, which must outlive the bundle.
  static Result<Bundle> parse(std::span<const std::byte> bytes, std::string name);

  /// Tags of the bundle's robots. Empty if the bundle is for one robot without a name.
  const std::vector<std::string>& embodiments() const { return embodiments_; }
  /// Selects one robot: its keys and tensors lose the prefix with the tag, and those of the other robots are removed.
  /// `tag` is empty where `embodiments` is. Errors: usage, with the list of tags.
  Status choose(const std::string& tag);
  /// The selected robot's tag, or empty.
  const std::string& embodiment() const { return embodiment_; }

  /// Removes keys that are not read again. A vocabulary takes megabytes.
  void forget(std::string_view prefix) { keys_.forget(prefix); }

  const std::string& path() const { return path_; }
  const Keys& keys() const { return keys_; }
  const std::vector<TensorInfo>& tensors() const { return tensors_; }
  const TensorInfo* find(std::string_view name) const;
  /// Reads statistics: an f32 or f64 tensor of one or two dimensions with finite values, in rows. Errors: bad_bundle.
  Result<std::vector<double>> stats(std::string_view name) const;
  std::size_t file_size() const { return content_->bytes().size(); }
  /// The byte range of a tensor in the file.
  std::ptrdiff_t offset(const std::byte* data) const { return data - content_->bytes().data(); }
  /// Returns the bytes of a tensor or of a part of it. Bytes of a file are read into `buffer`. Errors: bad_bundle if
  /// the file has changed since it was opened.
  Result<std::span<const std::byte>> read(std::span<const std::byte> part, ReadBuffer& buffer) const;
  /// The file or memory that tensors are read from; it may outlive the bundle.
  const std::shared_ptr<const Content>& content() const { return content_; }

 private:
  static Result<Bundle> parse(const std::shared_ptr<Content>& content, std::string name);

  void index();

  std::string path_, embodiment_;
  std::vector<std::string> embodiments_;
  std::shared_ptr<const Content> content_;
  Keys keys_;
  std::vector<TensorInfo> tensors_;
  std::unordered_map<std::string, std::size_t> index_;  // from a name to an index into tensors_
};

}  // namespace vla
