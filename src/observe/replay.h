// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "observe/recording.h"

namespace vla::observe {

struct ReplayOptions {
  std::string address = "tcp://127.0.0.1:5555";
  std::size_t first = 0;    // most requests to send; 0: all
  int timeout_ms = 60'000;  // timeout per answer
};

/// A field that differs between the recorded answer and the new one.
struct Difference {
  std::size_t index = 0;         // index of the request in the recording, from 1
  std::uint64_t request_id = 0;  // value in the recorded answer
  std::string field, recorded, replayed;
};

struct ReplayReport {
  v1::Description replayed_by;
  std::size_t n_same = 0, n_different = 0;
  std::size_t n_skipped = 0;  // not compared: health, and refusals by queue or deadline
  std::vector<Difference> differences;
};

/// Lists the fields that differ between two answers to the same request. Chunks: shape, action names, actions bit for
/// bit, rate, seed, notes, echoed time. Errors: code and place. Not compared: queue_ms, engine_ms and stages, which
/// differ from run to run; bundle, runtime and limits, which the caller compares once.
std::vector<Difference> compare_answers(const v1::Response& recorded, const v1::Response& replayed);

/// Sends the requests of a recording to a server again, one at a time and in order, and compares the answers. An act
/// whose seed was drawn is sent with that seed, and without its deadline. Errors: io (no answer), those of
/// Recording::next.
Result<ReplayReport> replay(Recording& recording, const ReplayOptions& options);

}  // namespace vla::observe
