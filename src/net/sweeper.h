// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>

#include "net/loop.h"

namespace vla::net {

/// Calls a function once a second, as far as this process runs: a machine that stood still counts no second.
class Sweeper {
 public:
  explicit Sweeper(const Loop& loop) : loop_(loop), last_(loop.now()) {}

  /// To be called before every turn of the loop, which comes at least once a second.
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
