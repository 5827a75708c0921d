// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "bundle/bundle.h"

namespace vla::test {

/// A bundle in pieces, to be changed and written again with a checksum that fits, so that a test reaches the check it
/// means.
struct EditableBundle {
  Keys keys;
  struct Piece {
    std::string name;
    DType type;
    std::vector<std::int64_t> shape;
    std::string data;
  };
  std::vector<Piece> tensors;

  /// Reads a bundle that must be sound.
  static EditableBundle read(const std::string& path);
  Piece& tensor(const std::string& name);
  void erase(const std::string& name);
  void set(const std::string& key, Value value) { keys.set(key, std::move(value)); }
  void remove_key(const std::string& key);

  /// The bytes of a GGUF file with a valid checksum.
  std::string bytes() const;
  /// Writes `bytes()` into the build's temporary folder. Returns the path.
  std::string write(const std::string& file_name) const;
};

/// A file of the repository.
std::string source_path(const std::string& path);
/// The folder of a golden case, `arch/name`, with its checkpoint and bundle; of all cases without a name. The first
/// call makes what is not there yet (tools/goldens).
std::string golden_path(const std::string& name = "");
/// The smallest golden bundle of each architecture.
std::vector<std::string> golden_bundles();
/// All of them, but under a sanitizer a third, and another third at the next call: for tests that compute each case.
std::vector<std::string> some_of(const std::vector<std::string>& all);
/// A place for files that a test writes.
std::string scratch_path(const std::string& file_name);
std::string write_file(const std::string& file_name, const std::string& bytes);
std::string read_text(const std::string& path);

}  // namespace vla::test
