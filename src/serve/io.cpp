// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/io.h"

#include <fmt/format.h>
#include <malloc.h>
#include <unistd.h>

#include <algorithm>

namespace vla::serve {
namespace {

constexpr auto kLinger = std::chrono::seconds(2);  // time to send the last answers before the thread ends
constexpr std::uint64_t kMaxDeadlineMs = 86'400'000;
constexpr int kTrimEvery = 5;  // seconds

Error shutting_down() { return {Code::shutting_down, "act", "", "the server drains before it stops"}; }

}  // namespace

void ServerState::begin() noexcept {
  ready = true;
  ready_since = Clock::now().time_since_epoch().count();
}

Health ServerState::health(const Exchange& exchange) const {
  const Clock::rep since = ready_since;  // before `ready`, which begin() sets first: uptime without `ready` is draining
  const Clock::duration up = Clock::now().time_since_epoch() - Clock::duration(since);
  return {ready,
          exchange.n_waiting(),
          exchange.computing(),
          since == 0 ? 0.0 : std::chrono::duration<double>(up).count(),
          n_chunk,
          n_error};
}

Io::Io(net::Loop& loop, const Fronts& fronts, Exchange& exchange, Policies& policies, ServerState& state,
       std::span<Observer* const> observers)
    : loop_(loop), fronts_(fronts), exchange_(exchange), policies_(policies), state_(state), observers_(observers) {}

void Io::run() {
  for (;;) {
    wait(exchange_.first_deadline());
    std::uint64_t signals;
    [[maybe_unused]] const auto drained = ::read(exchange_.fd(), &signals, sizeof(signals));
    deliver_waiting();
    if (state_.draining) {
      state_.ready = false;
      if (exchange_.drained()) state_.stopping = true;
    }
    if (state_.stopping) {
      state_.ready = false;
      exchange_.close();
      if (!state_.device_lost) refuse_waiting();
      if (exchange_.drained()) break;
    }
  }
  for (const auto end = now() + kLinger; has_answers() && now() < end;) wait(end);
  state_.ended = true;
}

void Io::wait(std::optional<Clock::time_point> until) {
  loop_.wait(
      [this] {
        for (const auto& front : fronts_) front->begin(*this);
        sweeper_.turn([this] { sweep(); });
      },
      exchange_.fd(), until);
}

/// Returns memory to the system: after a flood of acts, malloc keeps freed blocks between blocks in use.
void Io::sweep() {
  if (++n_sweep_ % kTrimEvery == 0) ::malloc_trim(0);
}

bool Io::has_answers() const {
  return std::any_of(fronts_.begin(), fronts_.end(), [](const auto& front) { return front->has_answers(); });
}

void Io::stop() noexcept {
  state_.stopping = true;
  exchange_.wake();
}

Result<v1::Description> Io::describe(const std::string& policy) const {
  VLA_TRY(const std::shared_ptr<ServedPolicy> found, policies_.find(policy));
  v1::Description description = found->description;
  for (const std::string& name : policies_.names()) description.add_policies(name);
  return description;
}

void Io::dropped(const Dropped& connection) {
  for (Observer* observer : observers_) observer->dropped(connection);
}

void Io::received(const Received& request) {
  for (Observer* observer : observers_) observer->received(request);
}

void Io::answer(Job job, std::string response) {
  Answer answer;
  answer.started = answer.finished = job.at;
  answer.job = std::move(job);
  answer.response = std::move(response);
  deliver(answer);
}

/// A queued act gets its answer later, so nothing may throw after an act is queued.
void Io::submit(Job job) {
  if (state_.stopping || state_.draining) return refuse(std::move(job), shutting_down);
  Result<std::shared_ptr<ServedPolicy>> policy = policies_.find(job.policy_name);
  if (!policy) return refuse(std::move(job), [&] { return policy.error(); });
  job.policy = std::move(*policy);
  if (const auto allowed = job.deadline_ms) {
    if (*allowed == 0 || *allowed > kMaxDeadlineMs)
      return refuse(std::move(job), [&] {
        return Error{Code::bad_observation, "deadline_ms", fmt::format("1 to {}", kMaxDeadlineMs),
                     std::to_string(*allowed)};
      });
    job.deadline = job.at + std::chrono::milliseconds(*allowed);
  }
  deliver_waiting();  // late acts must not occupy the place of one that can still be answered
  const std::uint64_t request_id = job.request_id;
  Exchange::Jobs::Pushed pushed = exchange_.push(std::move(job));
  if (pushed.superseded)
    refuse(std::move(*pushed.superseded), [&] {
      return Error{Code::superseded, "act", "",
                   fmt::format("request {} of this client came while this one waited", request_id),
                   "act on the newer one's answer"};
    });
  for (Job& refused : pushed.refused)
    refuse(std::move(refused), [&] {
      return Error{Code::busy, "act", "room in the queue",
                   fmt::format("{} acts of other clients that wait", exchange_.n_waiting()),
                   "ask again later, or less often"};
    });
}

/// Sends an answer, or reports to the client that memory for it ran out.
void Io::send_answer(Answer& answer) noexcept {
  try {
    if (answer.error) answer.response = answer.job.call->encode(*answer.error);
    deliver(answer);
  } catch (const std::exception&) {
    send_without_memory(answer);
  }
}

void Io::send_without_memory(Answer& answer) noexcept {
  answer.response = {};
  answer.job.call->send_out_of_memory();
  count_error();
}

/// The answer is lost if its peer has disconnected or has too many unread answers: the server never waits for a peer.
/// Everything that can fail runs before the answer is sent, so that no request gets two answers.
void Io::deliver(Answer& answer) {
  const Job& job = answer.job;
  const net::Bytes* const native = job.call->native();
  Answered answered{.request = job,
                    .error = answer.error ? &*answer.error : nullptr,
                    .started = answer.started,
                    .finished = answer.finished,
                    .sent = {},
                    .stages = std::move(answer.stages),
                    .n_sent = answer.response.size(),
                    .in = native != nullptr ? native->span() : std::as_bytes(std::span(answer.record.request)),
                    .out = std::as_bytes(std::span(native != nullptr ? answer.response : answer.record.response)),
                    .out_of_range = answer.out_of_range,
                    .n_beyond = answer.n_beyond,
                    .notes = answer.notes};
  job.call->send(answer.response);
  if (answer.error) {
    count_error();
  } else if (job.kind == Kind::act) {
    ++state_.n_chunk;
  }
  answered.sent = now();
  for (Observer* observer : observers_) observer->answered(answered);
}

/// Refuses all waiting acts: a server that stops finishes only the acts that it has begun.
void Io::refuse_waiting() {
  while (std::optional<Job> job = exchange_.take_waiting()) refuse(std::move(*job), shutting_down);
}

void Io::deliver_waiting() {
  while (std::optional<Answer> answer = exchange_.take_answer()) send_answer(*answer);
  while (std::optional<Job> job = exchange_.take_late(now())) {
    const std::uint64_t allowed = *job->deadline_ms;
    refuse(std::move(*job), [allowed] {
      return Error{Code::late, "deadline_ms", fmt::format("its turn within {} ms", allowed), "later",
                   "ask less often, or allow more time"};
    });
  }
}

}  // namespace vla::serve
