// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <boost/asio/io_context.hpp>
#include <boost/asio/steady_timer.hpp>
#include <chrono>
#include <functional>

namespace vla::net {

/// Calls a function once a second, as far as this process runs: a machine that stood still counts no second.
class Sweeper {
 public:
  explicit Sweeper(boost::asio::io_context& context) : timer_(context) {}

  /// To be called before every turn of the loop: it waits for the next second where it does not yet.
  void begin(const std::function<void()>& sweep) {
    if (is_waiting_) return;
    timer_.expires_after(std::chrono::seconds(1));
    timer_.async_wait([this, sweep](boost::system::error_code) {
      is_waiting_ = false;
      sweep();
    });
    is_waiting_ = true;
  }

 private:
  boost::asio::steady_timer timer_;
  bool is_waiting_ = false;
};

}  // namespace vla::net
