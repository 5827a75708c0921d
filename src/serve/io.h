// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <span>
#include <zmq.hpp>

#include "serve/curve.h"
#include "serve/exchange.h"
#include "serve/vla.pb.h"

namespace vla::serve {

/// What both threads and every observer may read.
struct Vitals {
  std::atomic<bool> ready = false, stopping = false;
  std::atomic<std::uint64_t> n_chunk = 0, n_error = 0;
  std::atomic<Clock::rep> ready_since = 0;

  Health health(const Exchange& exchange) const;
};

zmq::message_t to_message(const v1::Response& response);

/// The I/O thread: receives requests, answers at once what needs no engine, puts acts in line, and sends what comes
/// back. It never computes, so that no client waits for it while another one's act runs.
class Io {
 public:
  /// `gate` may be null. Everything outlives the thread.
  Io(zmq::socket_t& router, Gate* gate, Exchange& exchange, Vitals& vitals, const v1::Description& description,
     std::span<Observer* const> observers);

  /// Until the server is told to stop and everything that waits is answered.
  void run();

 private:
  void admit();
  bool receive();
  void handle(Job job, const Status& sound);
  Result<v1::Response> answer_now(const Job& job) const;
  void queue(Job job);
  void refuse(Job job, const Error& error);
  void deliver(Answer answer);
  void deliver_waiting();

  zmq::socket_t& router_;
  Gate* gate_;
  Exchange& exchange_;
  Vitals& vitals_;
  const v1::Description& description_;
  std::span<Observer* const> observers_;
};

}  // namespace vla::serve
