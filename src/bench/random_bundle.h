// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>

#include "bundle/bundle.h"

namespace vla::bench {

struct RandomSizes {
  int n_view = 2, max_tokens = 48, n_step = 10;
  DType dtype = DType::bf16;  // dtype of matrices and tables
  std::uint64_t seed = 0;
  bool is_filled = true;  // false: weights read as zeros and take no memory
};

/// A valid bundle of random weights, to measure a network of that size without a checkpoint. It is kept in memory, or
/// in an unnamed temporary file if memory cannot hold the bundle and an engine's copy of it, and is deleted with the
/// object. Values repeat after some millions, which does not change a product's time.
class RandomBundle {
 public:
  /// `network` has the keys that the architecture declares, such as PolicyEntry::published. Features, recipe, solver
  /// and a vocabulary of single bytes are added. Errors: unsupported, bad_bundle, out_of_memory.
  static Result<RandomBundle> make(const std::string& arch, const Keys& network, const RandomSizes& sizes);

  RandomBundle(RandomBundle&& other) noexcept : file_(other.file_) { other.file_ = -1; }
  RandomBundle& operator=(RandomBundle&&) = delete;
  ~RandomBundle();

  /// A path by which this process can open the bundle.
  std::string path() const { return "/proc/self/fd/" + std::to_string(file_); }

 private:
  explicit RandomBundle(int file) : file_(file) {}
  int file_;
};

}  // namespace vla::bench
