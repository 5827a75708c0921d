// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/io.h"

#include <fmt/format.h>
#include <unistd.h>

#include <array>
#include <new>

#include "serve/codec.h"
#include "serve/fields.h"

namespace vla::serve {
namespace {

constexpr int kTurn = 64;  // requests that are read before answers get their turn again
constexpr std::uint64_t kMaxDeadlineMs = 86'400'000;

std::span<const std::byte> bytes_of(const zmq::message_t& message) {
  return {message.data<std::byte>(), message.size()};
}

std::string hexadecimal(const zmq::message_t& message) {
  std::string text;
  for (const std::byte byte : bytes_of(message)) text += fmt::format("{:02x}", static_cast<unsigned>(byte));
  return text;
}

}  // namespace

zmq::message_t to_message(const v1::Response& response) {
  zmq::message_t message(response.ByteSizeLong());
  response.SerializeToArray(message.data(), static_cast<int>(message.size()));
  return message;
}

Health Vitals::health(const Exchange& exchange) const {
  const Clock::duration up = Clock::now().time_since_epoch() - Clock::duration(ready_since);
  return {ready,
          exchange.n_waiting(),
          exchange.computing(),
          ready_since == 0 ? 0.0 : std::chrono::duration<double>(up).count(),
          n_chunk,
          n_error};
}

Io::Io(zmq::socket_t& router, Gate* gate, Exchange& exchange, Vitals& vitals, const v1::Description& description,
       std::span<Observer* const> observers)
    : router_(router),
      gate_(gate),
      exchange_(exchange),
      vitals_(vitals),
      description_(description),
      observers_(observers) {}

void Io::run() {
  std::array<zmq_pollitem_t, 3> items = {{{nullptr, exchange_.fd(), ZMQ_POLLIN, 0},
                                          {router_.handle(), 0, ZMQ_POLLIN, 0},
                                          {gate_ ? gate_->socket().handle() : nullptr, 0, ZMQ_POLLIN, 0}}};
  for (;;) {
    zmq_poll(items.data(), gate_ ? 3 : 2, -1);
    std::uint64_t signals;
    [[maybe_unused]] const auto drained = ::read(exchange_.fd(), &signals, sizeof(signals));
    deliver_waiting();
    if (gate_ && (items[2].revents & ZMQ_POLLIN) != 0) admit();
    for (int n = 0; n < kTurn && receive(); ++n) {
    }
    if (vitals_.stopping) {
      vitals_.ready = false;
      exchange_.close();
      if (exchange_.drained()) return;
    }
  }
}

void Io::admit() {
  const std::optional<std::string> refused = gate_->answer();
  if (!refused) return;
  for (Observer* observer : observers_) observer->refused(*refused);
}

/// Takes one message in: [routing id][empty delimiter, if any][request]. False where there is none.
bool Io::receive() {
  Job job;
  if (!router_.recv(job.route, zmq::recv_flags::dontwait)) return false;
  bool more = router_.recv(job.bytes) && job.bytes.more();
  if (more && job.bytes.size() == 0) {
    job.delimiter = true;
    more = router_.recv(job.bytes) && job.bytes.more();
  }
  const bool is_one_frame = !more;
  for (zmq::message_t rest; more;) more = router_.recv(rest) && rest.more();
  job.at = Clock::now();
  job.client = hexadecimal(job.route);
  job.size = job.bytes.size();
  const Status sound = is_one_frame ? read_envelope(job.request(), job.envelope)
                                    : Status(not_a_request("request", "one frame", "several"));
  job.request_id = job.envelope.request_id;
  job.kind = job.envelope.kind;
  for (Observer* observer : observers_) observer->received(job);
  try {
    handle(std::move(job), sound);
  } catch (const std::bad_alloc&) {  // this request is lost: an answer would take memory too
  }
  return true;
}

void Io::handle(Job job, const Status& sound) {
  if (!sound) return refuse(std::move(job), sound.error());
  if (job.kind == Kind::act) return queue(std::move(job));
  auto response = answer_now(job);
  if (!response) return refuse(std::move(job), response.error());
  const Clock::time_point at = job.at;
  deliver({std::move(job), to_message(*response), std::nullopt, at, at, {}});
}

Result<v1::Response> Io::answer_now(const Job& job) const {
  v1::Response response = response_to(job.request_id);
  if (job.kind == Kind::hello) {
    VLA_TRY(*response.mutable_hello(), answer_hello(job.body()));
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

void Io::queue(Job job) {
  if (vitals_.stopping)
    return refuse(std::move(job), {Code::shutting_down, "act", "", "the server drains before it stops"});
  if (const auto deadline = job.envelope.deadline_ms) {
    if (*deadline == 0 || *deadline > kMaxDeadlineMs)
      return refuse(std::move(job), {Code::bad_observation, "act.deadline_ms", fmt::format("1 to {}", kMaxDeadlineMs),
                                     std::to_string(*deadline)});
    job.deadline = job.at + std::chrono::milliseconds(*deadline);
  }
  const std::uint64_t request_id = job.request_id;
  Exchange::Jobs::Pushed pushed = exchange_.push(std::move(job));
  if (pushed.superseded)
    refuse(
        std::move(*pushed.superseded),
        {Code::superseded, "act", "", fmt::format("request {} of this client came while this one waited", request_id),
         "act on the newer one's answer"});
  if (pushed.refused)
    refuse(std::move(*pushed.refused), {Code::busy, "act", "room in the queue",
                                        fmt::format("{} acts of other clients that wait", exchange_.n_waiting()),
                                        "ask again later, or less often"});
}

void Io::refuse(Job job, const Error& error) {
  v1::Response response = response_to(job.request_id);
  *response.mutable_error() = encode_error(error);
  const Clock::time_point at = job.at;
  deliver({std::move(job), to_message(response), error, at, at, {}});
}

/// A peer that is gone, or that does not read and has its share of answers waiting, loses this one; nobody waits for
/// it.
void Io::deliver(Answer answer) {
  Job& job = answer.job;
  if (answer.error) {
    ++vitals_.n_error;
  } else if (job.kind == Kind::act) {
    ++vitals_.n_chunk;
  }
  zmq::message_t response;
  response.copy(answer.response);  // shares the bytes, which observers read afterwards
  const auto part = zmq::send_flags::sndmore | zmq::send_flags::dontwait;
  router_.send(job.route, part);
  if (job.delimiter) router_.send(zmq::message_t(), part);
  router_.send(response, zmq::send_flags::dontwait);
  if (observers_.empty()) return;
  const Answered answered{job,
                          answer.error ? &*answer.error : nullptr,
                          answer.started,
                          answer.finished,
                          Clock::now(),
                          std::move(answer.stages),
                          job.request(),
                          bytes_of(answer.response)};
  for (Observer* observer : observers_) observer->answered(answered);
}

void Io::deliver_waiting() {
  for (Answer& answer : exchange_.take_answers()) deliver(std::move(answer));
  for (Job& job : exchange_.take_late()) {
    const Error error{Code::late, "act.deadline_ms", fmt::format("its turn within {} ms", *job.envelope.deadline_ms),
                      "later", "ask less often, or allow more time"};
    refuse(std::move(job), error);
  }
}

}  // namespace vla::serve
