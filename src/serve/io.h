// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <span>

#include "serve/exchange.h"
#include "serve/hub.h"
#include "serve/vla.pb.h"

namespace vla::serve {

/// What both threads and every observer may read.
struct Vitals {
  std::atomic<bool> ready = false, stopping = false;
  std::atomic<bool> device_lost = false;  // acts that wait get the device's error
  std::atomic<std::uint64_t> n_chunk = 0, n_error = 0;
  std::atomic<Clock::rep> ready_since = 0;

  void begin() noexcept;
  Health health(const Exchange& exchange) const;
};

/// The I/O thread: receives requests, answers at once what needs no engine, puts acts in line, and sends what comes
/// back. It never computes, so that no client waits for it while another one's act runs.
class Io final : public Hub::Handler {
 public:
  /// Everything outlives the thread.
  Io(Hub& hub, Exchange& exchange, Vitals& vitals, const v1::Description& description,
     std::span<Observer* const> observers);

  /// Until the server is stopped, what is computed is answered, and what waits is refused.
  void run();

  void received(Client& client, Message message) override;
  void dropped(const Client& client, const std::string& why, const std::string& detail) override;

 private:
  void handle(Client& client, Job job, const Status& sound);
  Result<v1::Response> answer_now(Client& client, const Job& job) const;
  void queue(Job job);
  template <class MakeError>
  void refuse(Job job, MakeError error) noexcept;
  void settle(Answer answer) noexcept;
  void deliver(Answer answer);
  void deliver_waiting();
  void refuse_waiting();
  void answer_without_memory(std::uint64_t connection, std::uint64_t request_id, bool delimiter) noexcept;

  Hub& hub_;
  Exchange& exchange_;
  Vitals& vitals_;
  const v1::Description& description_;
  std::span<Observer* const> observers_;
};

}  // namespace vla::serve
