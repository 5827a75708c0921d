// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "base/result.h"

namespace vla::observe {

/// Opens a file to write it from its start. With `fresh` it must not exist yet. Only its owner may read it, since it
/// holds what a robot sees and does. A symbolic link is refused: another user may have put it there. Errors: io.
Result<int> open_to_write(const std::string& path, bool fresh);

/// Writes to a file or a pipe from a thread of its own, so that the caller never waits for a disk or for a reader.
/// Pieces are written whole and in order; a piece that finds the queue full is dropped and counted.
class Writer {
 public:
  enum class Owns { no, yes };
  /// Closes `fd` at the end if it owns it. At most `max_waiting` bytes wait. If the thread cannot start, `failure` is
  /// set from the beginning. A closed pipe is a failure too, not a signal.
  Writer(int fd, Owns owns, std::size_t max_waiting);
  ~Writer() { close(); }
  Writer(const Writer&) = delete;
  Writer& operator=(const Writer&) = delete;

  /// Queues a piece. Returns false if the piece is dropped. Any thread may call it.
  bool put(std::string piece) noexcept;
  /// Writes the waiting pieces, then the tail, while somebody reads, and closes an owned file. Call no `put`
  /// afterwards.
  void close();
  /// Sets the text that `close` writes after all pieces, whether the queue is full or not. On a full disk it is left
  /// out, or, with `over_last`, overwrites the last piece of a file.
  void set_tail(std::string tail, bool over_last = false) { tail_ = std::move(tail), over_last_ = over_last; }
  std::uint64_t n_dropped() const { return n_dropped_; }
  /// The failure's errno, or 0. After a failure every piece is dropped.
  int failure() const { return failure_; }

 private:
  void run();
  bool write_all(const std::string& piece);
  void write_tail();
  bool is_out_of_patience() const;

  int fd_;  // -1 once it is closed
  const Owns owns_;
  const std::size_t max_waiting_;
  bool is_file_ = false;
  std::int64_t position_ = 0, last_ = 0;  // in a file: offset of the next piece, and of the last one written
  std::string tail_;
  bool over_last_ = false;
  std::atomic<std::uint64_t> n_dropped_ = 0;
  std::atomic<int> failure_ = 0;
  mutable std::mutex mutex_;
  std::condition_variable changed_;
  std::vector<std::string> waiting_;
  std::size_t waiting_bytes_ = 0;
  bool closing_ = false;
  std::chrono::steady_clock::time_point closing_since_;
  std::thread thread_;
};

}  // namespace vla::observe
