// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <memory>

#include "observe/observer.h"
#include "observe/writer.h"

namespace vla::observe {

/// Events for Perfetto and chrome://tracing: a track of each request from receipt to answer with its time in the queue,
/// and the acts of the engine with their stages. Streams a JSON array to the file. The array is complete even on a full
/// disk, and Perfetto reads it even if a killed process did not close it.
class Trace final : public Observer {
 public:
  static constexpr std::size_t kMaxBytes = std::size_t{1} << 30;
  /// Replaces the file. Events beyond `max_bytes` are dropped and counted. Errors: io.
  static Result<std::unique_ptr<Trace>> open(const std::string& path, std::size_t max_bytes = kMaxBytes);
  ~Trace() override;

  void answered(const Answered& answered) override;
  /// Requests dropped because the disk was too slow or the file was full.
  std::uint64_t n_dropped() const { return writer_.n_dropped() + n_beyond_; }

 private:
  Trace(int fd, std::size_t max_bytes);
  std::int64_t ns(Clock::time_point time) const;

  const Clock::time_point start_ = Clock::now();
  const std::size_t max_bytes_;
  std::uint64_t n_request_ = 0;  // for the I/O thread only, like `n_byte_`
  std::size_t n_byte_ = 0;
  std::atomic<std::uint64_t> n_beyond_ = 0;
  Writer writer_;
};

}  // namespace vla::observe
