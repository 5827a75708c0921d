// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <memory>

#include "serve/observer.h"
#include "serve/writer.h"

namespace vla::serve {

/// Events for Perfetto and chrome://tracing: a track of each request from receipt to answer with its time in the queue,
/// and the acts of the engine with their stages. Streams to the file: an array that Perfetto reads also where a killed
/// process has not closed it.
class Trace final : public Observer {
 public:
  /// Replaces the file. Errors: io.
  static Result<std::unique_ptr<Trace>> open(const std::string& path);
  ~Trace() override;

  void answered(const Answered& answered) override;
  /// Requests that the disk was too slow for.
  std::uint64_t n_dropped() const { return writer_.n_dropped(); }

 private:
  explicit Trace(int fd);
  std::int64_t ns(Clock::time_point time) const;

  const Clock::time_point start_ = Clock::now();
  std::uint64_t n_request_ = 0;  // of the I/O thread
  Writer writer_;
};

}  // namespace vla::serve
