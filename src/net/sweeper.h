// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>

#include "net/loop.h"

namespace vla::net {

/// Calls a function once per second of this process's own time: seconds during which the machine was suspended do not
/// count.
class Sweeper {
 public:
  explicit Sweeper(const Loop& loop) : loop_(loop), last_(loop.now()) {}

  /// Call it before every turn of the loop, at least once a second.
  template <class Sweep>
  void turn(Sweep sweep) {
    if (loop_.now() - last_ < std::chrono::seconds(1)) return;
    last_ = loop_.now();
    sweep();
  }

 private:
  const Loop& loop_;
  Clock::time_point last_;
};

}  // namespace vla::net
