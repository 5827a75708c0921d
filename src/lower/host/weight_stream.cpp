// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/host/weight_stream.h"

#include "base/thread.h"

namespace vla::lower {

Result<std::unique_ptr<WeightStream>> WeightStream::start(std::shared_ptr<const Content> content,
                                                          std::vector<std::vector<PackPart>> groups, int n_thread) {
  std::unique_ptr<WeightStream> stream(new WeightStream(std::move(content), std::move(groups)));
  Packer packer;
  for (const std::vector<PackPart>& parts : stream->groups_) packer.reserve(parts);
  for (int i = 0; i < n_thread; ++i) {
    VLA_TRY(std::thread thread,
            start_thread("threads that read weights", [all = stream.get(), packer] { all->serve(packer); }));
    stream->threads_.push_back(std::move(thread));
  }
  return stream;
}

/// Pads each round with empty groups, so that a group uses the same window in every round.
WeightStream::WeightStream(std::shared_ptr<const Content> content, std::vector<std::vector<PackPart>> groups)
    : content_(std::move(content)), groups_(std::move(groups)) {
  while (groups_.size() % kWindows != 0) groups_.emplace_back();
}

WeightStream::~WeightStream() {
  {
    const std::lock_guard lock(mutex_);
    stop_ = true;
  }
  may_read_.notify_all();
  for (std::thread& thread : threads_) thread.join();
}

/// The loop of a reading thread: reads part after part as long as windows are free.
void WeightStream::serve(Packer packer) {
  Lock lock(mutex_);
  while (true) {
    may_read_.wait(lock, [this] { return stop_ || has_part(); });
    if (stop_) return;
    const Turn turn = reading_;
    const bool begins = next_part_ == 0;
    const PackPart& part = take_part();
    ++n_busy_;
    lock.unlock();
    if (begins)
      for (const PackPart& next : parts(turn + 1)) content_->expect(next.from);
    const bool is_there = packer.run(*content_, part);
    lock.lock();
    --n_busy_;
    if (is_there)
      --n_left(turn);
    else
      has_failed_ = true;
    if (n_left(turn) == 0 || n_busy_ == 0) has_read_.notify_all();
  }
}

/// Whether a part can be read now. Skips empty groups.
bool WeightStream::has_part() {
  if (has_failed_ || moves_) return false;
  for (; reading_ < oldest_ + kWindows; ++reading_) {
    if (!parts(reading_).empty()) return true;
    n_left(reading_) = 0;
  }
  return false;
}

const PackPart& WeightStream::take_part() {
  const std::vector<PackPart>& all = parts(reading_);
  if (next_part_ == 0) n_left(reading_) = all.size();
  const PackPart& part = all[next_part_++];
  if (next_part_ == all.size()) ++reading_, next_part_ = 0;
  return part;
}

Status WeightStream::bring(int first, int last) {
  Lock lock(mutex_);
  const Turn begin = turn_of(first), end = begin + static_cast<Turn>(last - first) + 1;
  if (begin > oldest_ || has_failed_) go_to(begin, lock);
  has_read_.wait(lock, [&] { return are_loaded(begin, end) || has_failed_; });
  return has_failed_ ? Status(content_->changed()) : Status();
}

void WeightStream::release(int group) {
  Lock lock(mutex_);
  go_to(turn_of(group) + 1, lock);
}

/// The next turn of this group, from `oldest_` on.
WeightStream::Turn WeightStream::turn_of(int group) const {
  const Turn n = groups_.size();
  return oldest_ + (static_cast<Turn>(group) + n - oldest_ % n) % n;
}

bool WeightStream::are_loaded(Turn begin, Turn end) const {
  for (Turn turn = begin; turn < end; ++turn)
    if (turn >= reading_ || n_left(turn) > 0) return false;
  return true;
}

/// Frees the windows of all turns before `turn`. If the threads have not read those turns yet, they continue from
/// `turn`. Waits until no thread writes to a window that is being freed.
void WeightStream::go_to(Turn turn, Lock& lock) {
  if (has_failed_ || !are_loaded(oldest_, turn)) {
    moves_ = true;
    has_read_.wait(lock, [this] { return n_busy_ == 0; });
    moves_ = false;
    if (has_failed_ || turn > reading_) reading_ = turn, next_part_ = 0;
    has_failed_ = false;
  }
  oldest_ = turn;
  may_read_.notify_all();
}

}  // namespace vla::lower
