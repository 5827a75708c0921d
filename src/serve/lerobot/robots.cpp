// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/lerobot/robots.h"

#include <new>

#include "base/printable.h"
#include "serve/lerobot/async_inference.pb.h"
#include "wire/envelope.h"

namespace vla::serve::lerobot {
namespace {

// how long GetActions waits for an observation, as in the reference
constexpr auto kPatience = std::chrono::seconds(2);
constexpr double kRateHz = 30;  // the reference's, used if the bundle has none

std::span<const std::byte> bytes_of(const std::string& text) { return std::as_bytes(std::span(text)); }

Error error_of(const v1::Error& error) {
  return {wire::code_of(error.code()), error.where(), error.expected(), error.found(), error.hint()};
}

}  // namespace

void Robots::serve(Names names, const v1::Description& description) {
  names_ = std::move(names);
  description_ = description;
  period_ = 1 / (description.rate_hz() > 0 ? description.rate_hz() : kRateHz);
}

void Robots::called(Rpc rpc) {
  Client& client = clients_[rpc.peer.connection];
  client.peer = rpc.peer;
  client.used = now_();
  Result<std::string> answer = std::string();
  try {
    answer = answer_now(rpc, client);
  } catch (const std::bad_alloc&) {
    answer = Error{Code::out_of_memory, rpc.method, "", "no memory for it"};
  }
  if (!answer) {
    server_.refused(rpc.peer.connection);
    return calls_.refuse(rpc.id, answer.error());
  }
  if (rpc.method == "GetActions") {
    client.waiting.push_back({rpc.id, client.used});
  } else {
    calls_.answer(rpc.id, *answer);
  }
  ask(client);
}

/// Answers a call that needs no engine; GetActions gets no actions yet. An empty message is a serialized Empty.
Result<std::string> Robots::answer_now(Rpc& rpc, Client& client) {
  if (rpc.method == "Ready") {
    client.filter.begin();
    client.seen.reset();
    return std::string();
  }
  if (rpc.method == "SendPolicyInstructions") {
    transport::PolicySetup message;
    if (!message.ParseFromString(rpc.message))
      return Error{Code::bad_request, "PolicySetup", "LeRobot's message", "other bytes"};
    VLA_TRY(Setup setup, read_setup(bytes_of(message.data()), names_, description_));
    adopt(client, std::make_shared<const Setup>(std::move(setup)));
    return std::string();
  }
  if (rpc.method != "SendObservations" && rpc.method != "GetActions")
    return Error{Code::unsupported, "method", "those of transport.AsyncInference",
                 printable(rpc.method.substr(0, 100))};
  VLA_CHECK(check_setup(rpc, client));
  if (rpc.method == "SendObservations") VLA_CHECK(observe(rpc, client));
  return std::string();
}

/// A robot that reconnects after a broken connection does not send its setup again.
Status Robots::check_setup(const Rpc& rpc, Client& client) {
  if (client.setup) return {};
  if (Shared setup = setups_.for_return(client.peer.address)) return adopt(client, std::move(setup)), Status();
  return Error{Code::incompatible, rpc.method, "SendPolicyInstructions before it on this connection",
               setups_.is_ambiguous(client.peer.address)
                   ? "none, and robots of this address have different set-ups, or one that is still connected"
                   : "none",
               "start the robot's client again, which sends them"};
}

void Robots::adopt(Client& client, Shared setup) {
  client.setup = std::move(setup);
  if (setups_.had(client.peer.address, client.setup, now_())) keep(client.peer.address);
}

void Robots::keep(const std::string& address) {
  server_.keep(address, setups_.bytes_of(address));
  for (const std::string& forgotten : setups_.take_forgotten()) server_.keep(forgotten, {});
}

Status Robots::observe(const Rpc& rpc, Client& client) {
  VLA_TRY(const pickle::Pickle message, pickle::Pickle::read(bytes_of(rpc.message)));
  VLA_TRY(Observed observed, read_observation(message, *client.setup));
  if (!client.filter.takes(observed)) return {};
  Seen seen;
  VLA_TRY(*seen.request.mutable_act(), act_of(message, observed, *client.setup, names_, description_.limits()));
  seen.observed = std::move(observed);
  seen.size = seen.request.ByteSizeLong();
  client.seen = std::move(seen);
  bound_seen();
  return {};
}

/// Drops observations until all of them fit the limit, each from the group that holds most.
void Robots::bound_seen() {
  for (;;) {
    net::Standings all;
    for (const auto& [connection, client] : clients_)
      if (client.seen)
        all.push_back({connection, net::group_of(client.peer.address), true, {}, client.used, client.seen->size});
    const auto chosen = net::to_interrupt(all, 0, limits_.message, limits_.observed, now_());
    if (!chosen) return;
    clients_.at(*chosen).seen.reset();
  }
}

void Robots::ask(Client& client) {
  if (!client.seen || client.waiting.empty()) return;
  Seen seen = *std::exchange(client.seen, std::nullopt);
  client.filter.computes(seen.observed);
  seen.request.set_protocol_version(wire::kMaxVersion);
  seen.request.set_request_id(++client.n_request);
  const std::uint64_t rpc = client.waiting.front().rpc;
  client.waiting.pop_front();
  client.asked[client.n_request] = {rpc, std::move(seen.observed), client.setup};
  if (server_.ask(client.peer.connection, seen.request.SerializeAsString())) return;
  client.asked.erase(client.n_request);
  calls_.refuse(rpc, {Code::busy, "act", "a server that takes requests", "one that is behind", "ask again later"});
}

void Robots::answered(std::uint64_t connection, std::span<const std::byte> bytes) {
  const auto client = clients_.find(connection);
  v1::Response response;
  if (client == clients_.end() || !response.ParseFromArray(bytes.data(), static_cast<int>(bytes.size()))) return;
  const auto asked = client->second.asked.find(response.request_id());
  if (asked == client->second.asked.end()) return;
  const Result<std::string> actions = actions_of(response, asked->second);
  const std::uint64_t rpc = asked->second.rpc;
  client->second.asked.erase(asked);
  if (!actions) return calls_.refuse(rpc, actions.error());
  calls_.answer(rpc, *actions);
}

Result<std::string> Robots::actions_of(const v1::Response& response, const Asked& asked) const {
  if (response.has_error()) return error_of(response.error());
  const v1::ActionChunk& chunk = response.chunk();
  if (!response.has_chunk() ||
      std::uint64_t{chunk.horizon()} * chunk.d_action() != static_cast<std::uint64_t>(chunk.actions_size()))
    return Error{Code::internal, "act", "a chunk", "another answer", "report this"};
  transport::Actions actions;
  actions.set_data(encode_actions(chunk, asked.observed, *asked.setup, names_, period_));
  return actions.SerializeAsString();
}

void Robots::cancelled(std::uint64_t rpc) {
  for (auto& [connection, client] : clients_)
    std::erase_if(client.waiting, [&](const Waiting& waiting) { return waiting.rpc == rpc; });
}

void Robots::closed(const Peer& peer, const std::string& why, const std::string& detail) {
  if (const auto found = clients_.find(peer.connection); found != clients_.end()) {
    if (found->second.setup && setups_.ended(peer.address, now_())) keep(peer.address);
    clients_.erase(found);
  }
  server_.closed(peer, why, detail);
}

void Robots::sweep() {
  for (auto& [connection, client] : clients_)
    while (!client.waiting.empty() && now_() - client.waiting.front().since > kPatience) {
      calls_.answer(client.waiting.front().rpc, {});  // nothing yet
      client.waiting.pop_front();
    }
}

void Robots::stop() {
  for (auto& [connection, client] : clients_)
    for (const Waiting& waiting : std::exchange(client.waiting, {}))
      calls_.refuse(waiting.rpc, {Code::shutting_down, "call", "", "the server stops"});
}

}  // namespace vla::serve::lerobot
