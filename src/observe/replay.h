// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "observe/recording.h"

namespace vla::serve {

struct ReplayOptions {
  std::string address = "tcp://127.0.0.1:5555";
  std::size_t first = 0;    // only so many requests; 0: all
  int timeout_ms = 60'000;  // for each answer
};

/// A field in which a second answer differs from the recorded one.
struct Difference {
  std::size_t index = 0;         // of the request in the recording, from 1
  std::uint64_t request_id = 0;  // the recorded answer's
  std::string field, recorded, replayed;
};

struct ReplayReport {
  v1::Description replayed_by;
  std::size_t n_same = 0, n_different = 0;
  std::size_t n_skipped = 0;  // their answers tell of the moment: health, and what a queue or a deadline refused
  std::vector<Difference> differences;
};

/// Fields in which two answers to the same request differ. Chunks: shape, action names, actions bit for bit, rate,
/// seed, notes, echoed time. Errors: code and place. Not compared, since they differ from run to run: queue_ms,
/// engine_ms, stages; and bundle, runtime and limits, which the caller compares once.
std::vector<Difference> compare_answers(const v1::Response& recorded, const v1::Response& replayed);

/// Sends the requests of a recording to a server again, one at a time and in order, and compares its answers with the
/// recorded ones. An act that was given a drawn seed is sent with that seed, and without its deadline. Errors: io (no
/// answer), those of Recording::next.
Result<ReplayReport> replay(Recording& recording, const ReplayOptions& options);

}  // namespace vla::serve
