// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/openpi/front.h"

#include "serve/io.h"
#include "serve/openpi/codec.h"
#include "serve/token.h"

namespace vla::serve::openpi {

class Front::Request final : public Call {
 public:
  Request(Front& front, const Peer& peer, std::string bytes)
      : front_(front), connection_(peer.connection), previous_ms_(peer.total_ms), bytes_(std::move(bytes)) {}

  Status read(bool is_text) {
    if (is_text) return Error{Code::bad_request, "request", "a binary message", "a text message"};
    VLA_TRY(message_, msgpack::read(std::as_bytes(std::span(bytes_))));
    VLA_TRY(extension_, extension_of(message_.find(kExtension), kExtension));
    if (front_.options_.vllm_omni) {
      VLA_TRY(omni_, take_omni_keys(message_));
    }
    return {};
  }
  bool is_reset() const { return omni_.is_reset; }
  const Extension& extension() const { return extension_; }

  Result<ActRequest> decode(const ServedPolicy& policy) override {
    const Robot& robot = policy.engine->robot();
    VLA_TRY(ActRequest request,
            decode_act(message_, front_.names_, act_limits(front_.options_, robot), robot.bundle().embodiment()));
    if (omni_.seed) request.noise = *(request.seed = omni_.seed);
    return request;
  }
  std::string encode(Reply reply, const ServedPolicy&) override {
    if (front_.options_.vllm_omni) return encode_omni_reply(std::move(reply), front_.names_);
    return encode_reply(std::move(reply), front_.names_, previous_ms_);
  }
  std::string encode(const Error& error) override {
    if (front_.options_.vllm_omni) return encode_omni_error(error);
    is_refused_ = true;
    return encode_error(error);
  }
  void send(const std::string& answer) override {
    if (is_refused_) return front_.sockets_.fail(connection_, answer);
    front_.sockets_.send(connection_, answer);
  }
  void send_out_of_memory() noexcept override { front_.sockets_.drop(connection_); }

 private:
  Front& front_;
  const std::uint64_t connection_;
  const std::optional<double> previous_ms_;
  const std::string bytes_;
  msgpack::Value message_;  // refers to `bytes_`
  Extension extension_;
  OmniKeys omni_;
  bool is_refused_ = false;
};

Result<std::unique_ptr<Front>> Front::open(net::Loop& loop, const ServerOptions& options) {
  VLA_TRY(std::string key, read_token(options.api_token));
  std::unique_ptr<Front> front(new Front(loop, options, std::move(key)));
  VLA_TRY(front->address_, front->sockets_.bind(options.openpi, "--openpi", options.insecure));
  return front;
}

Front::Front(net::Loop& loop, const ServerOptions& options, std::string api_key)
    : options_(options),
      sockets_(loop, {options.max_message, options.max_connections, kReceiptMessages * options.max_message},
               std::move(api_key)) {}

Result<Names> Front::names_of(const ServerOptions& options, const v1::Description& description) {
  return names_for({options.preset, lines_of(options.map, false), options.absent}, description, "--openpi");
}

Status Front::serve(const ServedPolicy& policy) {
  VLA_CHECK(check_one_robot(*policy.engine, "--openpi"));
  VLA_TRY(names_, names_of(options_, policy.description));
  replaced(policy.description);
  return {};
}

void Front::replaced(const v1::Description& description) { metadata_ = encode_metadata(description, names_); }

void Front::begin(Io& io) {
  io_ = &io;
  sockets_.begin(*this);
}

void Front::dropped(const Peer& peer, const std::string& why, const std::string& detail) {
  io_->dropped({"openpi-" + std::to_string(peer.connection), peer.address, "", why, detail});
}

void Front::received(Peer& peer, std::string message, bool is_text) {
  Job job;
  job.client = "openpi-" + std::to_string(peer.connection);
  job.peer = peer.address;
  job.is_first = peer.n_request == 0;
  job.size = message.size();
  job.at = io_->now();
  job.share = {net::group_of(peer.address), peer.since};
  job.request_id = ++peer.n_request;
  auto request = std::make_unique<Request>(*this, peer, std::move(message));
  const Status valid = request->read(is_text);
  const bool is_reset = request->is_reset();
  job.kind = is_reset ? Kind::unknown : Kind::act;
  job.deadline_ms = request->extension().deadline_ms;
  job.call = std::move(request);
  io_->received(job);
  if (!valid) return io_->refuse(std::move(job), [&] { return valid.error(); });
  if (is_reset) return io_->answer(std::move(job), encode_omni_reset());
  io_->submit(std::move(job));
}

}  // namespace vla::serve::openpi
