// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/table_rows.h"

#include <algorithm>
#include <cstring>
#include <utility>

namespace vla::lower {
namespace {

constexpr std::int64_t kMostKept = 1024, kNoRow = -1;
/// How many cache places are tried for a row.
constexpr std::int64_t kTries = 16;

}  // namespace

Result<std::unique_ptr<TableRows>> TableRows::make(const Bundle& bundle, const Param& table) {
  std::unique_ptr<TableRows> rows(new TableRows);
  const auto n_row = static_cast<std::size_t>(table.shape[1]), n_kept = std::min<std::size_t>(n_row, kMostKept);
  rows->content_ = bundle.content(), rows->table_ = table.source->data;
  rows->row_size_ = rows->table_.size() / n_row;
  rows->index_.assign(n_kept, kNoRow);
  rows->buffer_.take(Content::buffer_size(rows->row_size_));  // allocated up front, so that a lookup allocates nothing
  VLA_TRY(rows->kept_, Memory::allocate(n_kept * rows->row_size_, "rows of " + table.name));
  return rows;
}

/// Returns the cache place that holds row i, after reading the row if it is not cached; null if the file no longer has
/// the row.
std::byte* TableRows::place(std::int64_t i) {
  const auto n = static_cast<std::int64_t>(index_.size());
  std::int64_t at = i % n;
  for (std::int64_t k = 0; k < std::min(n, kTries); ++k) {
    const std::int64_t next = (i + k) % n, found = index_[static_cast<std::size_t>(next)];
    if (found == i || found == kNoRow) {
      at = next;
      break;
    }
  }
  std::byte* const kept = kept_.data() + static_cast<std::size_t>(at) * row_size_;
  std::int64_t& index = index_[static_cast<std::size_t>(at)];
  if (index == i) return kept;
  index = kNoRow;
  const std::byte* row = content_->read(table_.subspan(static_cast<std::size_t>(i) * row_size_, row_size_), buffer_);
  if (row == nullptr) return nullptr;
  std::memcpy(kept, row, row_size_);
  index = i;
  return kept;
}

void TableRows::copy(std::int64_t i, std::byte* to) {
  const std::lock_guard lock(mutex_);
  if (const std::byte* row = place(i)) {
    std::memcpy(to, row, row_size_);
  } else {
    has_changed_ = true;
    std::memset(to, 0, row_size_);
  }
}

Status TableRows::status() {
  const std::lock_guard lock(mutex_);
  return std::exchange(has_changed_, false) ? Status(content_->changed()) : Status();
}

}  // namespace vla::lower
