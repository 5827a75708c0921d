// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/exchange.h"

#include <sys/eventfd.h>
#include <unistd.h>

#include <cerrno>
#include <cstdint>
#include <utility>

namespace vla::serve {

Exchange::Exchange(Jobs::Limits limits, Now now)
    : fd_(eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC)), now_(now), jobs_(limits) {}

Exchange::~Exchange() {
  if (fd_ >= 0) ::close(fd_);
}

void Exchange::wake() const noexcept {
  const int saved = errno;  // a signal handler must keep errno
  const std::uint64_t one = 1;
  [[maybe_unused]] const auto written = ::write(fd_, &one, sizeof(one));  // fails only if it is already signalled
  errno = saved;
}

std::optional<Job> Exchange::next() {
  std::unique_lock lock(mutex_);
  for (;;) {
    const auto deadline = jobs_.first_deadline();
    const bool has_late = deadline && *deadline <= now_();
    if (has_late) {
      wake();  // the I/O thread takes the late job and notifies this thread
    } else if (!jobs_.empty() && !(jobs_.is_crowded() && n_taken_ > 0)) {
      ++n_taken_;
      return jobs_.pop();
    } else if (closed_ && jobs_.empty()) {
      return std::nullopt;
    }
    work_.wait(lock);
  }
}

void Exchange::put(Answer answer) noexcept {
  {
    std::unique_lock lock(mutex_);
    work_.wait(lock, [this] { return !answer_; });
    answer_ = std::move(answer);
    --n_taken_;
    work_.notify_all();
  }
  wake();
}

Exchange::Jobs::Pushed Exchange::push(Job job) {
  const std::lock_guard lock(mutex_);
  Jobs::Pushed pushed = jobs_.push(std::move(job));
  work_.notify_all();
  return pushed;
}

std::optional<Answer> Exchange::take_answer() {
  const std::lock_guard lock(mutex_);
  work_.notify_all();
  return std::exchange(answer_, std::nullopt);
}

std::optional<Job> Exchange::take_late(Clock::time_point now) {
  const std::lock_guard lock(mutex_);
  work_.notify_all();
  return jobs_.take_late(now);
}

std::optional<Job> Exchange::take_waiting() {
  const std::lock_guard lock(mutex_);
  work_.notify_all();
  return jobs_.pop();
}

std::optional<Clock::time_point> Exchange::first_deadline() const {
  const std::lock_guard lock(mutex_);
  return jobs_.first_deadline();
}

void Exchange::close() {
  const std::lock_guard lock(mutex_);
  closed_ = true;
  work_.notify_all();
}

bool Exchange::drained() const {
  const std::lock_guard lock(mutex_);
  return jobs_.empty() && n_taken_ == 0 && !answer_;
}

std::size_t Exchange::n_waiting() const {
  const std::lock_guard lock(mutex_);
  return jobs_.size();
}

bool Exchange::computing() const {
  const std::lock_guard lock(mutex_);
  return n_taken_ > 0;
}

}  // namespace vla::serve
