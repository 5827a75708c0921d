// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <string>

#include "observe/recording.h"

namespace vla::serve {

/// The recordings of a server, one at a time, so that each is whole: one in the folder itself from the start, where
/// that is asked for, and one in a folder below, named by its time, whenever people begin another. From any thread.
class Recordings final : public Observer {
 public:
  /// Of the recording that runs, or of the last one.
  struct Standing {
    bool on = false;
    std::string folder;           // empty where there was none yet
    std::uint64_t n_request = 0;  // in it
    std::uint64_t bytes = 0;      // of all recordings together
    std::string why;              // it ended before people ended it; else empty
  };

  /// `max_bytes`: of all recordings together.
  Recordings(std::string folder, std::uint64_t max_bytes) : folder_(std::move(folder)), max_bytes_(max_bytes) {}

  /// Begins the one in the folder itself. Errors: io.
  Status open();
  /// Who answers; before the first request.
  void describe(const v1::Description& description);
  /// Begins one in a folder below. Errors: usage (one runs; no policy is loaded yet), io.
  Status begin();
  /// Ends the one that runs; its bytes are in the file then. Errors: usage where none runs.
  Status end();

  void answered(const Answered& answered) override;
  bool records() const override { return true; }
  Standing standing() const;
  std::uint64_t max_bytes() const { return max_bytes_; }

  /// Called where one begins or ends after `open`; it must not call back.
  void on_change(std::function<void(const Standing&)> tell) { tell_ = std::move(tell); }

 private:
  Status begin_in(const std::string& folder);
  void close();
  Standing now() const;

  const std::string folder_;
  const std::uint64_t max_bytes_;
  std::function<void(const Standing&)> tell_;
  std::mutex changing_;       // of who begins or ends a recording, and may wait for a disk
  mutable std::mutex mutex_;  // of the rest, never for long
  std::optional<v1::Description> description_;
  std::unique_ptr<Recorder> recorder_;  // one that ended by itself too, until people end it or begin another
  Standing last_;                       // of recordings that are closed; its bytes are of all of those
};

}  // namespace vla::serve
