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

/// The event loop of one thread, which the sockets of all protocols share. Users of `context` must be destroyed before
/// the loop; do not call `wait` once one of them is destroyed.
class Loop {
 public:
  /// Errors: std::runtime_error if the system has no descriptor left.
  explicit Loop(Now now = Clock::now);
  ~Loop();

  boost::asio::io_context& context();
  /// From any thread.
  Clock::time_point now() const { return now_(); }
  /// Handles sockets and timers until `fd` (the same in every call) is readable or `until` has passed: for one turn at
  /// least, for a second at most. `begin` starts pending operations; if it throws for lack of memory, the next call
  /// begins the rest.
  void wait(const std::function<void()>& begin, int fd, std::optional<Clock::time_point> until);

 private:
  class Waiting;
  const Now now_;
  std::unique_ptr<Waiting> waiting_;
};

}  // namespace vla::net
