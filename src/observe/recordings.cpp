// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "observe/recordings.h"

#include <fmt/chrono.h>
#include <fmt/format.h>

#include <algorithm>
#include <chrono>

namespace vla::observe {
namespace {

Error refused(const char* expected, const char* found) { return {Code::usage, "recording", expected, found}; }

/// A file name from the UTC time in microseconds, so that names sort by time and do not repeat.
std::string name_of_now() {
  const auto now = std::chrono::system_clock::now();
  const auto us = std::chrono::duration_cast<std::chrono::microseconds>(now.time_since_epoch()).count() % 1'000'000;
  return fmt::format("{:%Y%m%d-%H%M%S}-{:06}", fmt::gmtime(std::chrono::system_clock::to_time_t(now)), us);
}

}  // namespace

Status Recordings::open() {
  const std::lock_guard changing(changing_);
  return begin_in(folder_);
}

/// Reports also a recording whose last data could not be written.
Recordings::~Recordings() {
  const bool was_on = standing().on;
  close();
  if (was_on && !last_.why.empty() && tell_) tell_(last_);
}

void Recordings::describe(const v1::Description& description) {
  const std::lock_guard lock(mutex_);
  description_ = description;
  if (recorder_) recorder_->describe(description);
}

Status Recordings::begin() {
  const std::lock_guard changing(changing_);
  {
    const std::lock_guard lock(mutex_);
    if (now().on) return refused("none that runs", "one");
    if (!description_) return refused("a policy that is loaded", "none yet");
  }
  close();
  VLA_CHECK(begin_in(folder_ + "/" + name_of_now()));
  const std::lock_guard lock(mutex_);
  if (tell_ && now().on) tell_(now());
  return {};
}

Status Recordings::end() {
  const std::lock_guard changing(changing_);
  if (!standing().on) return refused("one that runs", "none");
  close();
  const std::lock_guard lock(mutex_);
  if (tell_) tell_(last_);
  return {};
}

Status Recordings::begin_in(const std::string& folder) {
  VLA_TRY(std::unique_ptr<Recorder> recorder, Recorder::open(folder, max_bytes_ - std::min(max_bytes_, last_.bytes)));
  recorder->on_stop([this](const std::string&, std::uint64_t) {  // under the lock, like every call of the recorder
    if (tell_) tell_(now());
  });
  const std::lock_guard lock(mutex_);
  recorder_ = std::move(recorder);
  last_.folder = folder;
  if (description_) recorder_->describe(*description_);
  return {};
}

/// Flushes to disk without the lock, so that requests do not wait for it.
void Recordings::close() {
  std::unique_ptr<Recorder> closed;
  {
    const std::lock_guard lock(mutex_);
    last_ = now();
    last_.on = false;
    closed = std::move(recorder_);
  }
  if (!closed) return;
  closed->close();
  const std::lock_guard lock(mutex_);
  last_.why = closed->why_stopped();
  last_.n_request = closed->n_recorded();
}

void Recordings::answered(const Answered& answered) {
  const std::lock_guard lock(mutex_);
  if (recorder_) recorder_->answered(answered);
}

Recordings::Standing Recordings::standing() const {
  const std::lock_guard lock(mutex_);
  return now();
}

Recordings::Standing Recordings::now() const {
  if (!recorder_) return last_;
  Standing standing = last_;
  standing.why = recorder_->why_stopped();
  standing.on = standing.why.empty();
  standing.n_request = recorder_->n_recorded();
  standing.bytes += recorder_->n_byte();
  return standing;
}

}  // namespace vla::observe
