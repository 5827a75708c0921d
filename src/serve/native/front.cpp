// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/native/front.h"

#include <new>

#include "base/out_of_memory.h"
#include "net/endpoint.h"
#include "serve/io.h"
#include "serve/native/call.h"
#include "serve/native/codec.h"
#include "zmtp/curve.h"

namespace vla::serve {
namespace {

/// Whoever can reach the server can move the robot: clients on other machines need a key, unless the user allows all
/// with --insecure.
Result<std::optional<zmtp::CurveKeys>> guard(const ServerOptions& options) {
  const bool has_keys = !options.curve_secret.empty();
  if (has_keys != !options.curve_clients.empty())
    return Error{Code::usage, "--curve-secret", "--curve-secret and --curve-clients together", "one of them"};
  for (const std::string& endpoint : options.bind) {
    VLA_TRY(const net::Reach reach, net::reach_of(endpoint));
    if (reach == net::Reach::remote && !has_keys && !options.insecure)
      return Error{Code::usage, "--bind", "keys for an address that other machines can reach", endpoint + " without",
                   "vla keygen makes keys for --curve-secret and --curve-clients; --insecure lets everybody in"};
  }
  std::optional<zmtp::CurveKeys> keys;
  if (!has_keys) return keys;
  VLA_TRY(keys, zmtp::read_keys(options.curve_secret, options.curve_clients));
  return keys;
}

}  // namespace

class NativeFront::Request final : public NativeCall {
 public:
  Request(NativeFront& front, std::uint64_t connection, zmtp::Message message, const wire::Envelope& envelope)
      : NativeCall(front.options_, std::move(message.bytes), envelope),
        front_(front),
        connection_(connection),
        before_(std::move(message.envelope)) {}

  void send(const std::string& answer) override { front_.hub_.send(connection_, answer, before_); }
  void send_out_of_memory() noexcept override {
    free();
    front_.send_out_of_memory(connection_, request_id(), before_);
  }

 private:
  NativeFront& front_;
  const std::uint64_t connection_;
  const zmtp::Envelope before_;  // frames that precede the answer
};

Result<std::unique_ptr<NativeFront>> NativeFront::open(net::Loop& loop, const ServerOptions& options) {
  VLA_TRY(auto keys, guard(options));
  std::unique_ptr<NativeFront> front(new NativeFront(loop, options, std::move(keys)));
  VLA_CHECK(front->bind());
  return front;
}

NativeFront::NativeFront(net::Loop& loop, const ServerOptions& options, std::optional<zmtp::CurveKeys> keys)
    : options_(options),
      keys_(std::move(keys)),
      hub_(loop, {options.max_message, options.max_connections, kReceiptMessages * options.max_message},
           keys_ ? &*keys_ : nullptr) {}

Status NativeFront::bind() {
  for (const std::string& endpoint : options_.bind) {
    VLA_CHECK(net::check_free(endpoint, "--bind"));
    VLA_TRY(std::string bound, hub_.bind(endpoint));
    addresses_.push_back(std::move(bound));
  }
  return {};
}

void NativeFront::begin(Io& io) {
  io_ = &io;
  hub_.begin(*this);
}

void NativeFront::dropped(const zmtp::Client& client, const std::string& why, const std::string& detail) {
  io_->dropped({std::to_string(client.connection), client.peer, client.name, why, detail});
}

void NativeFront::received(zmtp::Client& client, zmtp::Message message) {
  const std::uint64_t connection = client.connection;
  const zmtp::Envelope before = message.envelope;
  std::uint64_t request_id = 0;
  try {
    Status valid = message.refused ? Status(*message.refused) : Status();
    wire::Envelope envelope;  // read first, so that a refusal for lack of memory has the request's number
    const Status read = wire::read_envelope(message.bytes.span(), envelope);
    request_id = envelope.request_id;
    if (valid) valid = read;
    Job job;
    job.client = std::to_string(connection);
    job.peer = client.peer;
    job.name = client.name;
    job.is_first = client.n_request == 0;
    job.request_id = request_id;
    job.kind = envelope.kind;
    job.policy_name = envelope.policy;
    job.size = message.size;
    job.at = io_->now();
    job.share = {net::group_of(client.peer), client.since};
    job.deadline_ms = envelope.deadline_ms;
    job.call = std::make_unique<Request>(*this, connection, std::move(message), envelope);
    ++client.n_request;
    io_->received(job);
    handle(client, std::move(job), envelope, valid);
  } catch (const std::bad_alloc&) {
    send_out_of_memory(connection, request_id, before);
    io_->count_error();
  }
}

/// Refuses a request for lack of memory.
void NativeFront::send_out_of_memory(std::uint64_t connection, std::uint64_t request_id,
                                     const zmtp::Envelope& before) noexcept try {
  hub_.send(connection, refusal(request_id, out_of_memory("request")), before);
} catch (const std::exception&) {  // no memory even for that; the client times out
}

void NativeFront::handle(zmtp::Client& client, Job job, const wire::Envelope& envelope, const Status& valid) {
  if (!valid) return io_->refuse(std::move(job), [&] { return valid.error(); });
  if (job.kind == Kind::act) return io_->submit(std::move(job));
  auto response = answer_now(client, job, envelope);
  job.name = client.name;  // a hello sets it
  if (!response) return io_->refuse(std::move(job), [&] { return response.error(); });
  io_->answer(std::move(job), response->SerializeAsString());
}

Result<v1::Response> NativeFront::answer_now(zmtp::Client& client, const Job& job,
                                             const wire::Envelope& envelope) const {
  const std::span<const std::byte> body = envelope.body(job.call->native()->span());
  v1::Response response = response_to(job.request_id);
  if (job.kind == Kind::hello) {
    VLA_TRY(*response.mutable_hello(), answer_hello(body, &client.name));
    return response;
  }
  if (job.kind == Kind::describe) {
    VLA_TRY(const std::string name, read_describe(body));
    VLA_TRY(*response.mutable_description(), io_->describe(name));
    return response;
  }
  VLA_CHECK(check_empty(body));
  const Health now = io_->health();
  v1::HealthReply& reply = *response.mutable_health();
  reply.set_ready(now.ready);
  reply.set_queue_depth(static_cast<std::uint32_t>(now.n_waiting));
  reply.set_computing(now.computing);
  reply.set_uptime_s(now.uptime_s);
  reply.set_chunks_served(now.n_chunk);
  reply.set_errors_served(now.n_error);
  return response;
}

}  // namespace vla::serve
