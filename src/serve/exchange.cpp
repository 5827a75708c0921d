// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/exchange.h"

#include <sys/eventfd.h>
#include <unistd.h>

#include <cerrno>
#include <cstdint>
#include <iterator>

namespace vla::serve {

Exchange::Exchange(Jobs::Limits limits) : fd_(eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC)), jobs_(limits) {}

Exchange::~Exchange() {
  if (fd_ >= 0) ::close(fd_);
}

void Exchange::wake() const noexcept {
  const int saved = errno;  // a signal handler must leave it as it was
  const std::uint64_t one = 1;
  [[maybe_unused]] const auto written = ::write(fd_, &one, sizeof(one));  // fails only where it is signalled already
  errno = saved;
}

void Exchange::move_late(Clock::time_point now) {
  std::vector<Job> late = jobs_.take_late(now);
  if (late.empty()) return;
  std::move(late.begin(), late.end(), std::back_inserter(late_));
  wake();
}

std::optional<Job> Exchange::next() {
  std::unique_lock lock(mutex_);
  for (;;) {
    move_late(Clock::now());
    if (!jobs_.empty()) break;
    if (closed_) return std::nullopt;
    work_.wait(lock);
  }
  computing_ = true;
  return jobs_.pop();
}

void Exchange::put(Answer answer) {
  {
    const std::lock_guard lock(mutex_);
    answers_.push_back(std::move(answer));
    computing_ = false;
  }
  wake();
}

Exchange::Jobs::Pushed Exchange::push(Job job) {
  const std::lock_guard lock(mutex_);
  move_late(job.at);  // they must not keep a place from one that can still be answered
  Jobs::Pushed pushed = jobs_.push(std::move(job));
  work_.notify_one();
  return pushed;
}

std::vector<Answer> Exchange::take_answers() {
  const std::lock_guard lock(mutex_);
  return std::exchange(answers_, {});
}

std::vector<Job> Exchange::take_late() {
  const std::lock_guard lock(mutex_);
  return std::exchange(late_, {});
}

void Exchange::close() {
  const std::lock_guard lock(mutex_);
  closed_ = true;
  work_.notify_one();
}

bool Exchange::drained() const {
  const std::lock_guard lock(mutex_);
  return jobs_.empty() && !computing_ && answers_.empty() && late_.empty();
}

std::size_t Exchange::n_waiting() const {
  const std::lock_guard lock(mutex_);
  return jobs_.size();
}

bool Exchange::computing() const {
  const std::lock_guard lock(mutex_);
  return computing_;
}

}  // namespace vla::serve
