// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/lerobot/front.h"

#include <algorithm>

#include "base/printable.h"
#include "serve/io.h"
#include "serve/lerobot/async_inference.pb.h"

namespace vla::serve::lerobot {
namespace {

constexpr auto kPatience = std::chrono::seconds(2);  // of GetActions without an observation, as the reference's
constexpr double kRateHz = 30;                       // the reference's, where the bundle says none

std::string name_of(const Peer& peer) { return "lerobot-" + std::to_string(peer.connection); }

}  // namespace

class Front::Request final : public Call {
 public:
  Request(Front& front, std::uint64_t rpc, std::shared_ptr<const Observed> observed, std::shared_ptr<const Setup> setup)
      : front_(front), rpc_(rpc), observed_(std::move(observed)), setup_(std::move(setup)) {}

  Result<ActRequest> decode(const ServedPolicy& policy) override {
    const Robot& robot = policy.engine->robot();
    return decode_act(*observed_, *setup_, front_.names_, act_limits(front_.options_, robot),
                      robot.bundle().embodiment());
  }
  std::string encode(Reply reply, const ServedPolicy&) override {
    transport::Actions actions;
    actions.set_data(encode_actions(std::move(reply), *observed_, *setup_, front_.names_, front_.period_));
    return actions.SerializeAsString();
  }
  std::string encode(const Error& error) override {
    error_ = error;
    return {};
  }
  void send(const std::string& answer) override {
    if (error_) return front_.rpcs_.refuse(rpc_, *error_);
    front_.rpcs_.answer(rpc_, answer);
  }
  void send_out_of_memory() noexcept override {
    front_.rpcs_.refuse(rpc_, {Code::out_of_memory, "act", "", "no memory for its answer"});
  }

 private:
  Front& front_;
  const std::uint64_t rpc_;
  const std::shared_ptr<const Observed> observed_;
  const std::shared_ptr<const Setup> setup_;
  std::optional<Error> error_;
};

Result<std::unique_ptr<serve::Front>> Front::open(net::Loop& loop, const ServerOptions& options) {
  std::unique_ptr<Front> front(new Front(loop, options));
  VLA_TRY(front->address_, front->rpcs_.bind(options.lerobot, "--lerobot", options.insecure));
  return std::unique_ptr<serve::Front>(std::move(front));
}

Front::Front(net::Loop& loop, const ServerOptions& options)
    : options_(options),
      loop_(loop),
      rpcs_(loop,
            {options.max_message, options.max_connections, kReceiptMessages * (options.max_message + Rpcs::kMaxPiece)}),
      sweeper_(loop) {}

Status Front::serve(const ServedPolicy& policy) {
  VLA_CHECK(check_one_robot(*policy.engine, "--lerobot"));
  VLA_TRY(names_, lerobot_names(options_.map, policy.description));
  description_ = policy.description;
  period_ = 1 / (description_.rate_hz() > 0 ? description_.rate_hz() : kRateHz);
  return {};
}

void Front::begin(Io& io) {
  io_ = &io;
  rpcs_.begin(*this);
  sweeper_.turn([this] { sweep(); });
}

void Front::called(Rpc rpc) {
  Client& client = client_of(rpc.peer);
  client.used = loop_.now();
  if (rpc.method == "GetActions" && client.setup) {
    client.asking.push_back({rpc.id, client.used});
    return submit_next(client);
  }
  const Result<std::string> answer = answer_now(rpc, client);
  if (!answer) {
    io_->count_error();
    return rpcs_.refuse(rpc.id, answer.error());
  }
  rpcs_.answer(rpc.id, *answer);
  submit_next(client);
}

/// Answers a call that needs no engine. An empty message is the serialized Empty.
Result<std::string> Front::answer_now(Rpc& rpc, Client& client) {
  if (rpc.method == "Ready") {
    client.filter.begin();
    client.observed.reset();
    return std::string();
  }
  if (rpc.method == "SendPolicyInstructions") {
    transport::PolicySetup message;
    if (!message.ParseFromString(rpc.message))
      return Error{Code::bad_request, "PolicySetup", "LeRobot's message", "other bytes"};
    VLA_TRY(Setup setup, read_setup(std::as_bytes(std::span(message.data())), names_, description_));
    client.setup = std::make_shared<const Setup>(std::move(setup));
    return std::string();
  }
  if (rpc.method != "SendObservations" && rpc.method != "GetActions")
    return Error{Code::unsupported, "method", "those of transport.AsyncInference",
                 printable(rpc.method.substr(0, 100))};
  if (!client.setup)
    return Error{Code::incompatible, rpc.method, "SendPolicyInstructions before it", "none",
                 "start the robot's client again"};
  VLA_TRY(const auto observed, read_observation(std::move(rpc.message), *client.setup));
  if (client.filter.takes(*observed)) client.observed = observed;
  bound_observed();
  return std::string();
}

/// A robot whose connection broke comes back on another one, and does not say again what it is.
Front::Client& Front::client_of(const Peer& peer) {
  const auto found = clients_.find(peer.connection);
  if (found != clients_.end()) return found->second;
  evict_idle();
  Client& client = clients_[peer.connection];
  client.peer = peer;
  const Client* before = nullptr;
  for (const auto& [connection, other] : clients_)
    if (&other != &client && other.peer.address == peer.address && (before == nullptr || other.used > before->used))
      before = &other;
  if (before != nullptr) client.setup = before->setup;
  return client;
}

/// The robot that was silent longest is forgotten for a new one.
void Front::evict_idle() {
  if (clients_.size() < options_.max_connections) return;
  const auto oldest = std::min_element(clients_.begin(), clients_.end(),
                                       [](const auto& a, const auto& b) { return a.second.used < b.second.used; });
  for (const Client::Asking& asking : oldest->second.asking)
    rpcs_.refuse(asking.rpc, {Code::busy, "robots", "fewer", std::to_string(clients_.size())});
  clients_.erase(oldest);
}

/// Observations that nobody asked for yet hold no more than requests in receipt may: one of those whose group holds
/// most is dropped.
void Front::bound_observed() {
  const std::size_t most = kReceiptMessages * options_.max_message;
  for (;;) {
    net::Standings all;
    for (const auto& [connection, client] : clients_)
      if (client.observed)
        all.push_back(
            {connection, net::group_of(client.peer.address), true, {}, client.used, client.observed->bytes.size()});
    const auto chosen = net::to_interrupt(all, 0, options_.max_message, most, loop_.now());
    if (!chosen) return;
    clients_.at(*chosen).observed.reset();
  }
}

void Front::submit_next(Client& client) {
  if (!client.observed || client.asking.empty()) return;
  const std::shared_ptr<const Observed> observed = std::exchange(client.observed, nullptr);
  const std::uint64_t rpc = client.asking.front().rpc;
  client.asking.pop_front();
  client.filter.computes(*observed);
  Job job;
  job.client = name_of(client.peer);
  job.peer = client.peer.address;
  job.share = {net::group_of(client.peer.address), client.peer.since};
  job.is_first = client.n_request == 0;
  job.size = observed->bytes.size();
  job.at = loop_.now();
  job.request_id = ++client.n_request;
  job.kind = Kind::act;
  job.call = std::make_unique<Request>(*this, rpc, observed, client.setup);
  io_->received(job);
  io_->submit(std::move(job));
}

void Front::cancelled(std::uint64_t rpc) {
  for (auto& [connection, client] : clients_)
    std::erase_if(client.asking, [&](const Client::Asking& asking) { return asking.rpc == rpc; });
  rpcs_.refuse(rpc, {Code::late, "call", "", "the client has cancelled it"});
}

void Front::ended(const Peer& peer, const std::string& why, const std::string& detail) {
  if (const auto found = clients_.find(peer.connection); found != clients_.end()) found->second.observed.reset();
  if (!why.empty()) io_->dropped({name_of(peer), peer.address, "", why, detail});
}

void Front::sweep() {
  for (auto& [connection, client] : clients_)
    while (!client.asking.empty() && loop_.now() - client.asking.front().since > kPatience) {
      rpcs_.answer(client.asking.front().rpc, {});  // nothing yet
      client.asking.pop_front();
    }
}

}  // namespace vla::serve::lerobot
