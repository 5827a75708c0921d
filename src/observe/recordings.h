// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <string>

#include "observe/recording.h"

namespace vla::observe {

/// A server's recordings, one at a time: optionally one in the folder itself from the start, and one in a subfolder
/// named by its time whenever a person starts another. Any thread may call.
class Recordings final : public Observer {
 public:
  /// State of the current recording, or of the last one.
  struct Standing {
    bool on = false;
    std::string folder;           // empty before the first one
    std::uint64_t n_request = 0;  // requests in the recording
    std::uint64_t bytes = 0;      // bytes of all recordings
    std::string why;              // why it ended by itself; else empty
  };

  /// `max_bytes`: limit of all recordings together.
  Recordings(std::string folder, std::uint64_t max_bytes) : folder_(std::move(folder)), max_bytes_(max_bytes) {}

  ~Recordings() override;

  /// Starts the recording in the folder itself. Errors: io.
  Status open();
  /// Describes the server. Call it before the first request.
  void describe(const v1::Description& description);
  /// Starts one in a subfolder. Errors: usage (one is running, or no policy is loaded yet), io.
  Status begin();
  /// Ends the running one; then its bytes are in the file. Errors: usage if none is running.
  Status end();

  void answered(const Answered& answered) override;
  bool records() const override { return true; }
  Standing standing() const;
  std::uint64_t max_bytes() const { return max_bytes_; }

  /// Called when a recording starts or ends after `open`; it must not call back.
  void on_change(std::function<void(const Standing&)> tell) { tell_ = std::move(tell); }

 private:
  Status begin_in(const std::string& folder);
  void close();
  Standing now() const;

  const std::string folder_;
  const std::uint64_t max_bytes_;
  std::function<void(const Standing&)> tell_;
  std::mutex changing_;       // held while a recording starts or ends, which may wait for a disk
  mutable std::mutex mutex_;  // guards the rest, held briefly
  std::optional<v1::Description> description_;
  std::unique_ptr<Recorder> recorder_;  // kept after it ended by itself, until a person ends it or starts another
  Standing last_;                       // bytes of closed recordings
};

}  // namespace vla::observe
