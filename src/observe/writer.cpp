// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "observe/writer.h"

#include <fcntl.h>
#include <poll.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <climits>
#include <cstring>
#include <new>

#include "base/thread.h"

namespace vla::observe {
namespace {

constexpr auto kDrainPatience = std::chrono::seconds(2);  // at shutdown, for a pipe without a reader
constexpr int kPollMs = 100;

}  // namespace

Result<int> open_to_write(const std::string& path, bool fresh) {
  const int flags = O_WRONLY | O_CREAT | O_CLOEXEC | O_NONBLOCK | O_NOFOLLOW | (fresh ? O_EXCL : O_TRUNC);
  const int fd = ::open(path.c_str(), flags, 0600);
  struct stat info;
  const bool is_file = fd >= 0 && ::fstat(fd, &info) == 0 && S_ISREG(info.st_mode);
  if (is_file && !fresh && ::fchmod(fd, 0600) != 0) errno = 0;  // another user's file keeps its mode
  if (fd >= 0) return fd;
  if (errno == EEXIST) return Error{Code::io, path, "no such file yet", "one", "name another place, or remove it"};
  if (errno == ELOOP) return Error{Code::io, path, "a file", "a symbolic link", "name the file that it leads to"};
  return Error{Code::io, path, "a file that can be written", std::strerror(errno)};
}

Writer::Writer(int fd, Owns owns, std::size_t max_waiting) : fd_(fd), owns_(owns), max_waiting_(max_waiting) {
  struct stat info;
  is_file_ = ::fstat(fd, &info) == 0 && S_ISREG(info.st_mode) && owns == Owns::yes;
  if (is_file_) position_ = last_ = ::lseek(fd, 0, SEEK_CUR);
  auto thread = start_thread("writer", [this] { run(); });
  if (thread) {
    thread_ = std::move(*thread);
  } else {
    failure_ = EAGAIN;
  }
}

void Writer::close() {
  if (fd_ < 0) return;
  {
    const std::lock_guard lock(mutex_);
    closing_ = true;
    closing_since_ = std::chrono::steady_clock::now();
  }
  changed_.notify_one();
  if (thread_.joinable()) thread_.join();
  write_tail();
  if (owns_ == Owns::yes) ::close(fd_);
  fd_ = -1;
}

bool Writer::put(std::string piece) noexcept {
  try {
    const std::lock_guard lock(mutex_);
    if (failure_ == 0 && waiting_bytes_ + piece.size() <= max_waiting_) {
      waiting_bytes_ += piece.size();
      waiting_.push_back(std::move(piece));
      changed_.notify_one();
      return true;
    }
  } catch (const std::bad_alloc&) {  // the piece is dropped; the server continues
  }
  ++n_dropped_;
  return false;
}

void Writer::run() {
  std::vector<std::string> pieces;
  for (;;) {
    {
      std::unique_lock lock(mutex_);
      changed_.wait(lock, [this] { return closing_ || !waiting_.empty(); });
      if (waiting_.empty()) return;
      pieces.swap(waiting_);
    }
    for (std::string& piece : pieces) {
      if (!write_all(piece)) ++n_dropped_;
      const std::lock_guard lock(mutex_);
      waiting_bytes_ -= piece.size();
      std::string().swap(piece);
    }
    pieces.clear();
  }
}

bool Writer::is_out_of_patience() const {
  const std::lock_guard lock(mutex_);
  return closing_ && std::chrono::steady_clock::now() - closing_since_ > kDrainPatience;
}

/// A pipe that poll reports as writable takes PIPE_BUF bytes without blocking.
bool Writer::write_all(const std::string& piece) {
  for (std::size_t at = 0; at < piece.size() && failure_ == 0;) {
    pollfd item = {fd_, POLLOUT, 0};
    const int ready = ::poll(&item, 1, kPollMs);
    if (ready == 0 || (ready < 0 && errno == EINTR)) {
      if (is_out_of_patience()) failure_ = ETIMEDOUT;
      continue;
    }
    const std::size_t left = piece.size() - at;
    const ssize_t n = ::write(fd_, piece.data() + at, is_file_ ? left : std::min<std::size_t>(left, PIPE_BUF));
    if (n >= 0) {
      at += static_cast<std::size_t>(n);
    } else if (errno != EINTR && errno != EAGAIN) {
      failure_ = errno;
    }
  }
  if (failure_ == 0) {
    last_ = position_;
    position_ += static_cast<std::int64_t>(piece.size());
    return true;
  }
  [[maybe_unused]] const int cut = is_file_ ? ::ftruncate(fd_, position_) : 0;  // a full disk keeps whole pieces only
  return false;
}

/// On a full disk, the tail overwrites the last piece: that space is already allocated.
void Writer::write_tail() {
  write_all(tail_);
  if (failure_ == 0 || !is_file_ || !over_last_) return;
  for (const std::int64_t at : {position_, last_}) {
    if (::pwrite(fd_, tail_.data(), tail_.size(), at) != static_cast<ssize_t>(tail_.size())) continue;
    if (::ftruncate(fd_, at + static_cast<std::int64_t>(tail_.size())) == 0) return;
  }
}

}  // namespace vla::observe
