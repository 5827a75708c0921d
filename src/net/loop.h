// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <optional>

#include "base/clock.h"

namespace boost::asio {
class io_context;
}

namespace vla::net {

/// The event loop of one thread, which the sockets of all protocols share. What uses `context` is destroyed before the
/// loop, and the loop does not wait any more once the first of them is.
class Loop {
 public:
  /// Errors: std::runtime_error where the system has no descriptor.
  explicit Loop(Now now = Clock::now);
  ~Loop();

  boost::asio::io_context& context();
  /// From any thread.
  Clock::time_point now() const { return now_(); }
  /// Handles what sockets and timers bring until `fd`, the same in every call, can be read or `until` has come, for a
  /// second at most, and for one turn at least. `begin` starts what waits: where it throws for lack of memory, the next
  /// call begins the rest.
  void wait(const std::function<void()>& begin, int fd, std::optional<Clock::time_point> until);

 private:
  class Waiting;
  const Now now_;
  std::unique_ptr<Waiting> waiting_;
};

}  // namespace vla::net
