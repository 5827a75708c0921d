// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <mutex>
#include <vector>

#include "bundle/params.h"
#include "lower/host/memory.h"

namespace vla::lower {

/// Rows of an embedding table that stays in the bundle's file: an observation reads few rows of a vocabulary. A row is
/// read at its first lookup, and up to 1024 rows are cached. Safe for several threads.
class TableRows {
 public:
  /// Errors: out_of_memory.
  static Result<std::unique_ptr<TableRows>> make(const Bundle& bundle, const Param& table);

  /// Copies row i as stored. Copies zeros if the file no longer has the row; `status` then returns the error.
  void copy(std::int64_t i, std::byte* to);
  std::size_t row_size() const { return row_size_; }
  /// Returns and clears the status of the rows copied since the last call. Errors: bad_bundle if the file has changed.
  Status status();
  /// Maximum bytes of the cache.
  std::size_t size() const { return kept_.size(); }

 private:
  TableRows() = default;
  std::byte* place(std::int64_t i);

  std::shared_ptr<const Content> content_;
  std::span<const std::byte> table_;
  std::size_t row_size_ = 0;
  Memory kept_;
  std::vector<std::int64_t> index_;  // row held in each place
  ReadBuffer buffer_;
  bool has_changed_ = false;
  std::mutex mutex_;
};

}  // namespace vla::lower
