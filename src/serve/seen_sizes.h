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

/// The sizes of acts that a server has computed, in a file. The next start computes one of each, so that no client pays
/// for its plan, and on a GPU for its graph of thousands of kernels. Any thread.
class SeenSizes {
 public:
  /// So many are kept, the newest: each takes an act at the start.
  static constexpr std::size_t kMost = 32;

  /// Reads the file; one that is not there is made with the first act. `tell` gets the error of a file that cannot be
  /// written, once. Errors: io, usage (a file of something else).
  static Result<std::unique_ptr<SeenSizes>> open(std::string path, std::function<void(const Error&)> tell);

  /// Those of a bundle, by the name of its file.
  std::vector<ActShape> of(const Engine& engine) const;
  /// Keeps the size of the engine's last act, and writes the file where it is new.
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
  std::vector<Entry> all_;  // in the order in which they came
};

}  // namespace vla::serve
