// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/gr00t/front.h"

#include "base/out_of_memory.h"
#include "base/printable.h"
#include "net/endpoint.h"
#include "serve/io.h"
#include "serve/token.h"

namespace vla::serve::gr00t {
namespace {

/// An error in the reference's own wording.
Error in_words(Code code, std::string words) { return {code, "", "", std::move(words)}; }

Kind kind_of(const std::string& endpoint) {
  if (endpoint == "get_action") return Kind::act;
  if (endpoint == "get_modality_config") return Kind::describe;
  return endpoint == "ping" ? Kind::health : Kind::unknown;
}

}  // namespace

class Front::Request final : public Call {
 public:
  Request(Front& front, std::uint64_t connection, zmtp::Message message)
      : front_(front),
        connection_(connection),
        envelope_(std::move(message.envelope)),
        bytes_(std::move(message.bytes)) {}

  /// Decodes the request and returns its endpoint. Errors: bad_request, bad_observation.
  Result<std::string> read() {
    VLA_TRY(message_, msgpack::read(bytes_.span()));
    if (!message_.is_map()) return Error{Code::bad_request, "request", "a map", "another type"};
    const msgpack::Value* token = message_.find("api_token");
    if (!front_.api_token_.empty() &&
        !is_same_secret(token != nullptr && token->is_text() ? token->data : std::string_view(), front_.api_token_))
      return in_words(Code::bad_request, "Unauthorized: Invalid API token");
    const msgpack::Value* endpoint = message_.find("endpoint");
    if (endpoint != nullptr && !endpoint->is_text())
      return Error{Code::bad_request, "endpoint", "text", "another type"};
    const std::string name = endpoint == nullptr ? "get_action" : std::string(endpoint->data);
    if (name == "get_action") {
      VLA_TRY(observed_, read_observation(message_.find("data")));
    }
    return name;
  }
  const Observed& observed() const { return observed_; }

  Result<ActRequest> decode(const ServedPolicy& policy) override {
    const Robot& robot = policy.engine->robot();
    ActRequest request;
    VLA_TRY(request.observation, observe(observed_.flat, front_.names_, act_limits(front_.options_, robot)));
    request.observation.embodiment = robot.bundle().embodiment();
    request.seed = observed_.extension.seed ? *observed_.extension.seed : fresh_seed();
    request.noise = *request.seed;
    return request;
  }
  std::string encode(Reply reply, const ServedPolicy& policy) override {
    return encode_reply(std::move(reply), observed_.dialect, front_.names_, policy.description);
  }
  std::string encode(const Error& error) override { return encode_error(error); }
  void send(const std::string& answer) override { front_.hub_.send(connection_, answer, envelope_); }
  void send_out_of_memory() noexcept override try {
    bytes_ = {};
    send(encode_error(out_of_memory("request")));
  } catch (const std::exception&) {  // no memory even for the error; the client times out
  }

 private:
  Front& front_;
  const std::uint64_t connection_;
  const zmtp::Envelope envelope_;
  net::Bytes bytes_;
  msgpack::Value message_;  // refers to `bytes_`, like `observed_`
  Observed observed_;
};

Result<std::unique_ptr<Front>> Front::open(net::Loop& loop, const ServerOptions& options) {
  const std::string endpoint = "tcp://" + options.gr00t;
  VLA_TRY(const net::Reach reach, net::reach_of(endpoint));
  if (reach == net::Reach::remote && !options.insecure)
    return Error{Code::usage, "--gr00t", "an address of this machine's own, such as 127.0.0.1:5556",
                 options.gr00t + ", which other machines can reach", "--insecure lets everybody in"};
  VLA_TRY(std::string token, read_token(options.api_token));
  std::unique_ptr<Front> front(new Front(loop, options, std::move(token)));
  VLA_TRY(front->address_, front->hub_.bind(endpoint));
  return front;
}

Front::Front(net::Loop& loop, const ServerOptions& options, std::string api_token)
    : options_(options),
      api_token_(std::move(api_token)),
      hub_(loop, {options.max_message, options.max_connections, kReceiptMessages * options.max_message}, nullptr) {}

Result<Names> Front::names_of(const ServerOptions& options, const v1::Description& description) {
  return own_names({{}, lines_of(options.map, true), options.absent}, description, "--gr00t");
}

Status Front::serve(const ServedPolicy& policy) {
  VLA_CHECK(check_one_robot(*policy.engine, "--gr00t"));
  VLA_TRY(names_, names_of(options_, policy.description));
  replaced(policy.description);
  if (options_.gr00t_n1_5) last_ = {msgpack::Framing::npy, true, true, false};
  return {};
}

void Front::begin(Io& io) {
  io_ = &io;
  hub_.begin(*this);
}

void Front::dropped(const zmtp::Client& client, const std::string& why, const std::string& detail) {
  io_->dropped({"gr00t-" + std::to_string(client.connection), client.peer, "", why, detail});
}

/// Every message is answered: clients of the first releases wait for ever.
void Front::received(zmtp::Client& client, zmtp::Message message) {
  Job job;
  job.client = "gr00t-" + std::to_string(client.connection);
  job.peer = client.peer;
  job.is_first = client.n_request == 0;
  job.size = message.size;
  job.at = io_->now();
  job.share = {net::group_of(client.peer), client.since};
  job.request_id = ++client.n_request;
  const std::optional<Error> refused = message.refused;
  auto request = std::make_unique<Request>(*this, client.connection, std::move(message));
  const Result<std::string> endpoint = refused ? Result<std::string>(*refused) : request->read();
  if (endpoint) job.kind = kind_of(*endpoint);
  if (job.kind == Kind::act) last_ = request->observed().dialect;
  job.deadline_ms = request->observed().extension.deadline_ms;
  job.call = std::move(request);
  io_->received(job);
  if (!endpoint) return io_->refuse(std::move(job), [&] { return endpoint.error(); });
  if (job.kind == Kind::act) return io_->submit(std::move(job));
  auto answer = answer_now(*endpoint);
  if (!answer) return io_->refuse(std::move(job), [&] { return answer.error(); });
  io_->answer(std::move(job), std::move(*answer));
  if (*endpoint == "kill") io_->stop();
}

Result<std::string> Front::answer_now(const std::string& endpoint) const {
  if (endpoint == "ping") return encode_ping();
  if (endpoint == "reset") return encode_reset();
  if (endpoint == "get_modality_config") return encode_modalities(last_, names_, description_);
  if (endpoint != "kill") return in_words(Code::bad_request, "Unknown endpoint: " + printable(endpoint.substr(0, 100)));
  if (options_.gr00t_kill) return encode_nothing();
  return Error{Code::unsupported, "kill", "", "clients do not stop this server", "--gr00t-kill lets them"};
}

}  // namespace vla::serve::gr00t
