// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/io.h"

#include <fmt/format.h>
#include <unistd.h>

#include <new>

#include "serve/codec.h"
#include "serve/fields.h"

namespace vla::serve {
namespace {

constexpr auto kLinger = std::chrono::seconds(2);  // for the last answers on the way out
constexpr std::uint64_t kMaxDeadlineMs = 86'400'000;

Job job_of(const Client& client, Message message) {
  Job job;
  job.client = std::to_string(client.connection);
  job.peer = client.peer;
  job.name = client.name;
  job.is_first = client.n_request == 0;
  job.size = message.size;
  job.at = Clock::now();
  job.connection = client.connection;
  job.delimiter = message.delimiter;
  job.bytes = std::move(message.bytes);
  return job;
}

Error shutting_down() { return {Code::shutting_down, "act", "", "the server drains before it stops"}; }

}  // namespace

void Vitals::begin() noexcept {
  ready = true;
  ready_since = Clock::now().time_since_epoch().count();
}

Health Vitals::health(const Exchange& exchange) const {
  const Clock::rep since = ready_since;  // before `ready`, which begin() sets first: up and not ready is draining
  const Clock::duration up = Clock::now().time_since_epoch() - Clock::duration(since);
  return {ready,
          exchange.n_waiting(),
          exchange.computing(),
          since == 0 ? 0.0 : std::chrono::duration<double>(up).count(),
          n_chunk,
          n_error};
}

Io::Io(Hub& hub, Exchange& exchange, Vitals& vitals, const v1::Description& description,
       std::span<Observer* const> observers)
    : hub_(hub), exchange_(exchange), vitals_(vitals), description_(description), observers_(observers) {}

void Io::run() {
  for (;;) {
    hub_.wait(*this, exchange_.fd(), exchange_.first_deadline());
    std::uint64_t signals;
    [[maybe_unused]] const auto drained = ::read(exchange_.fd(), &signals, sizeof(signals));
    deliver_waiting();
    if (vitals_.stopping) {
      vitals_.ready = false;
      exchange_.close();
      if (!vitals_.device_lost) refuse_waiting();
      if (exchange_.drained()) return hub_.flush(*this, Clock::now() + kLinger);
    }
  }
}

void Io::dropped(const Client& client, const std::string& why, const std::string& detail) {
  const Dropped dropped{std::to_string(client.connection), client.peer, client.name, why, detail};
  for (Observer* observer : observers_) observer->dropped(dropped);
}

void Io::received(Client& client, Message message) {
  const std::uint64_t connection = client.connection;
  const bool delimiter = message.delimiter;
  std::uint64_t request_id = 0;
  try {
    Status sound = message.refused ? Status(*message.refused) : Status();
    Job job = job_of(client, std::move(message));
    ++client.n_request;
    const Status envelope = read_envelope(job.request(), job.envelope);
    if (sound) sound = envelope;
    request_id = job.request_id = job.envelope.request_id;
    job.kind = job.envelope.kind;
    for (Observer* observer : observers_) observer->received(job);
    handle(client, std::move(job), sound);
  } catch (const std::bad_alloc&) {
    answer_without_memory(connection, request_id, delimiter);
  }
}

/// What was answered otherwise has been freed by now.
void Io::answer_without_memory(std::uint64_t connection, std::uint64_t request_id, bool delimiter) noexcept try {
  v1::Response response = response_to(request_id);
  *response.mutable_error() = encode_error(out_of_memory("request"));
  hub_.send(connection, response.SerializeAsString(), delimiter);
  ++vitals_.n_error;
} catch (const std::exception&) {  // not even for that: the client's patience ends it
}

void Io::handle(Client& client, Job job, const Status& sound) {
  if (!sound) return refuse(std::move(job), [&] { return sound.error(); });
  if (job.kind == Kind::act) return queue(std::move(job));
  auto response = answer_now(client, job);
  job.name = client.name;  // a hello tells it
  if (!response) return refuse(std::move(job), [&] { return response.error(); });
  const Clock::time_point at = job.at;
  deliver({std::move(job), response->SerializeAsString(), std::nullopt, at, at, {}});
}

Result<v1::Response> Io::answer_now(Client& client, const Job& job) const {
  v1::Response response = response_to(job.request_id);
  if (job.kind == Kind::hello) {
    VLA_TRY(*response.mutable_hello(), answer_hello(job.body(), &client.name));
    return response;
  }
  VLA_CHECK(check_empty(job.body()));
  if (job.kind == Kind::describe) {
    *response.mutable_description() = description_;
    return response;
  }
  const Health now = vitals_.health(exchange_);
  v1::HealthReply& reply = *response.mutable_health();
  reply.set_ready(now.ready);
  reply.set_queue_depth(static_cast<std::uint32_t>(now.n_waiting));
  reply.set_computing(now.computing);
  reply.set_uptime_s(now.uptime_s);
  reply.set_chunks_served(now.n_chunk);
  reply.set_errors_served(now.n_error);
  return response;
}

/// An act that waits has its answer still to come, so nothing may throw once it is in line.
void Io::queue(Job job) {
  if (vitals_.stopping) return refuse(std::move(job), shutting_down);
  if (const auto deadline = job.envelope.deadline_ms) {
    if (*deadline == 0 || *deadline > kMaxDeadlineMs)
      return refuse(std::move(job), [&] {
        return Error{Code::bad_observation, "deadline_ms", fmt::format("1 to {}", kMaxDeadlineMs),
                     std::to_string(*deadline)};
      });
    job.deadline = job.at + std::chrono::milliseconds(*deadline);
  }
  deliver_waiting();  // acts that are late must not keep a place from one that can still be answered
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

/// Makes the error only where the memory for it may be lacking.
template <class MakeError>
void Io::refuse(Job job, MakeError error) noexcept {
  const std::uint64_t connection = job.connection, request_id = job.request_id;
  const bool delimiter = job.delimiter;
  try {
    Answer answer;
    answer.error = error();
    answer.started = answer.finished = job.at;
    answer.job = std::move(job);
    settle(std::move(answer));
  } catch (const std::exception&) {
    answer_without_memory(connection, request_id, delimiter);
  }
}

/// Sends an answer. A client whose answer there is no memory for hears of that.
void Io::settle(Answer answer) noexcept {
  const std::uint64_t connection = answer.job.connection, request_id = answer.job.request_id;
  const bool delimiter = answer.job.delimiter;
  try {
    if (answer.error) {
      v1::Response response = response_to(request_id);
      *response.mutable_error() = encode_error(*answer.error);
      answer.response = response.SerializeAsString();
    }
    deliver(std::move(answer));
  } catch (const std::exception&) {
    answer_without_memory(connection, request_id, delimiter);
  }
}

/// A peer that has disconnected, or that has too many unread answers, loses this one; the server never waits for a
/// peer. What can fail comes before it is sent, so that no request gets two answers.
void Io::deliver(Answer answer) {
  const Job& job = answer.job;
  Answered answered{job,
                    answer.error ? &*answer.error : nullptr,
                    answer.started,
                    answer.finished,
                    {},
                    std::move(answer.stages),
                    job.request(),
                    std::as_bytes(std::span(answer.response)),
                    answer.is_beyond,
                    answer.notes};
  hub_.send(job.connection, answer.response, job.delimiter);
  if (answer.error) {
    ++vitals_.n_error;
  } else if (job.kind == Kind::act) {
    ++vitals_.n_chunk;
  }
  answered.sent = Clock::now();
  for (Observer* observer : observers_) observer->answered(answered);
}

/// An act in line could take as long as all before it: a server that stops finishes only what it has begun.
void Io::refuse_waiting() {
  while (std::optional<Job> job = exchange_.take_waiting()) refuse(std::move(*job), shutting_down);
}

void Io::deliver_waiting() {
  while (std::optional<Answer> answer = exchange_.take_answer()) settle(std::move(*answer));
  while (std::optional<Job> job = exchange_.take_late(Clock::now())) {
    const std::uint64_t allowed = *job->envelope.deadline_ms;
    refuse(std::move(*job), [allowed] {
      return Error{Code::late, "deadline_ms", fmt::format("its turn within {} ms", allowed), "later",
                   "ask less often, or allow more time"};
    });
  }
}

}  // namespace vla::serve
