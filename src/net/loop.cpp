// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "net/loop.h"

#include <unistd.h>

#include <algorithm>
#include <boost/asio/io_context.hpp>
#include <boost/asio/posix/stream_descriptor.hpp>
#include <exception>

namespace vla::net {
namespace {

constexpr int kRound = 64;  // socket events handled before the caller gets a turn
constexpr Clock::duration kLongest = std::chrono::seconds(1);

}  // namespace

class Loop::Waiting {
 public:
  void wait(const std::function<void()>& begin, int fd, Clock::duration at_most) {
    try {
      begin();
      watch(fd);
      context.restart();
      is_woken_ = false;
      context.run_one_for(at_most);
      for (int n = 0; n < kRound && !is_woken_ && context.poll_one() > 0; ++n) {
      }
    } catch (const std::exception&) {  // no memory: the next call begins the rest
    }
  }

  boost::asio::io_context context{1};

 private:
  void watch(int fd) {
    if (!woken_by_) woken_by_.emplace(context, ::dup(fd));
    if (is_watching_) return;
    woken_by_->async_wait(boost::asio::posix::stream_descriptor::wait_read, [this](boost::system::error_code) {
      is_woken_ = true;
      is_watching_ = false;
    });
    is_watching_ = true;
  }

  std::optional<boost::asio::posix::stream_descriptor> woken_by_;
  bool is_watching_ = false, is_woken_ = false;
};

Loop::Loop(Now its_now) : now_(its_now), waiting_(std::make_unique<Waiting>()) {}
Loop::~Loop() = default;
boost::asio::io_context& Loop::context() { return waiting_->context; }
void Loop::wait(const std::function<void()>& begin, int fd, std::optional<Clock::time_point> until) {
  waiting_->wait(begin, fd, until ? std::clamp(*until - now(), Clock::duration::zero(), kLongest) : kLongest);
}

}  // namespace vla::net
