// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <mutex>
#include <vector>

#include "bundle/params.h"
#include "lower/host/memory.h"

namespace vla::lower {

/// Rows of a table, which stays where the bundle has it: of a vocabulary's embeddings an observation reads a few. A row
/// is read when it is looked up first; the last thousand are kept. Threads may share it.
class TableRows {
 public:
  /// Errors: out_of_memory.
  static Result<std::unique_ptr<TableRows>> make(const Bundle& bundle, const Param& table);

  /// Row i as it is stored; zeros where the bundle has not this row any more, which `status` then tells.
  void copy(std::int64_t i, std::byte* to);
  std::size_t row_size() const { return row_size_; }
  /// The status of the rows copied since it was last asked for. Errors: bad_bundle, where the file has been changed.
  Status status();
  /// Bytes of the rows that are kept, at most.
  std::size_t size() const { return kept_.size(); }

 private:
  TableRows() = default;
  std::byte* place(std::int64_t i);

  std::shared_ptr<const Content> content_;
  std::span<const std::byte> table_;
  std::size_t row_size_ = 0;
  Memory kept_;
  std::vector<std::int64_t> index_;  // of the row in each place
  ReadBuffer buffer_;
  bool has_changed_ = false;
  std::mutex mutex_;
};

}  // namespace vla::lower
