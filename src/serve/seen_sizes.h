// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <utility>
#include <vector>

#include "engine/engine.h"

namespace vla::serve {

/// Keeps the input sizes of a server's acts in a file. The next start computes one act of each size, so that no client
/// waits for its plan or, on a GPU, for its graph of thousands of kernels. Any thread may use it.
class SeenSizes {
 public:
  /// Number of sizes kept, the newest ones: each costs an act at the start.
  static constexpr std::size_t kMost = 32;

  /// Reads the file; if it is missing, the first act creates it. `tell` is called once with the error if the file
  /// cannot be written. Errors: io; usage if the file contains something else.
  static Result<std::unique_ptr<SeenSizes>> open(std::string path, std::function<void(const Error&)> tell);

  /// Returns the sizes of a bundle, found by the name of its file.
  std::vector<ActShape> of(const Engine& engine) const;
  /// Keeps the size of the engine's last act, and writes the file if the size is new.
  void add(const Engine& engine);

 private:
  using Entry = std::pair<std::string, ActShape>;  // the name of the bundle's file

  SeenSizes(std::string path, std::function<void(const Error&)> tell)
      : path_(std::move(path)), tell_(std::move(tell)) {}
  Status read();
  std::string text() const;

  std::string path_;
  std::function<void(const Error&)> tell_;
  mutable std::mutex mutex_;
  std::vector<Entry> all_;  // oldest first
};

}  // namespace vla::serve
