// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Receives calls, their headers and gRPC messages, and hands complete calls to the handler in turn.
// Source: gRPC, doc/PROTOCOL-HTTP2.md.
#include <fmt/format.h>

#include <algorithm>
#include <boost/asio/post.hpp>

#include "door/connection.h"
#include "serve/lerobot/async_inference.pb.h"

namespace vla::door {
namespace {

constexpr std::size_t kCallCost = 4 << 10;  // bytes that a call counts for before any data arrives

}  // namespace

Call* Connection::find(std::int32_t stream) {
  const auto found = calls_.find(stream);
  return found == calls_.end() ? nullptr : found->second.get();
}

void Connection::hold(Call& call, std::ptrdiff_t n) {
  if (n_held_ == 0) began_ = shared_.loop.now();
  call.n_held += static_cast<std::size_t>(n);
  n_held_ += static_cast<std::size_t>(n);
  shared_.n_held += static_cast<std::size_t>(n);
}

void Connection::begin_call(std::int32_t stream) {
  auto call = std::make_unique<Call>(Call{.connection = *this, .stream = stream});
  Call& kept = *calls_.emplace(stream, std::move(call)).first->second;
  kept.id = ++shared_.n_id;
  kept.began = shared_.loop.now();
  is_open_ = true;
  ++shared_.n_call;
  shared_.calls.emplace(kept.id, &kept);
  hold(kept, kCallCost);
  shared_.bound_calls();
}

void Connection::take_header(std::int32_t stream, std::string_view name, std::string_view value) {
  Call* const call = find(stream);
  if (call == nullptr) return;
  call->header_bytes += name.size() + value.size() + 32;
  if (call->header_bytes > kMaxHeaderList) return drop("flood", "too many bytes of headers");
  if (name == ":path") call->method = value.substr(value.rfind('/') + 1);
  if (name == "content-type") call->content_type = value;
}

void Connection::end_headers(std::int32_t stream, bool is_last) {
  Call* const call = find(stream);
  if (call == nullptr) return;
  if (shared_.is_stopping) return refuse(*call, {Code::shutting_down, "call", "", "the server stops"});
  if (!call->content_type.starts_with("application/grpc"))
    return refuse(*call, {Code::bad_request, "content-type", "application/grpc", "another"});
  if (is_last) end_stream(stream);
}

void Connection::take_data(std::int32_t stream, std::string_view data) {
  Call* const call = find(stream);
  if (call == nullptr || call->is_answered || call->is_whole) return;
  hold(*call, static_cast<std::ptrdiff_t>(data.size()));
  call->framed += data;
  take_frames(*call);
}

/// A gRPC message: one byte for compression, the length, then the data.
void Connection::take_frames(Call& call) {
  while (call.framed.size() >= 5 && !call.is_whole && !call.is_answered) {
    const auto* head = reinterpret_cast<const unsigned char*>(call.framed.data());
    const std::size_t size =
        std::size_t{head[1]} << 24 | std::size_t{head[2]} << 16 | std::size_t{head[3]} << 8 | head[4];
    if (head[0] != 0) return refuse(call, {Code::unsupported, "grpc-encoding", "identity", "a compressed message"});
    if (size > Rpcs::kMaxPiece)
      return refuse(call, {Code::too_large, "message", fmt::format("at most {} bytes", Rpcs::kMaxPiece),
                           fmt::format("{} bytes", size)});
    if (call.framed.size() < 5 + size) return;
    const std::string framed = std::exchange(call.framed, {});
    if (const Status taken = take_message(call, std::string_view(framed).substr(5, size)); !taken)
      return refuse(call, taken.error());
    call.framed = framed.substr(5 + size);
  }
  if (call.is_whole) hand_over(call);
}

Status Connection::take_message(Call& call, std::string_view message) {
  if (call.method != "SendObservations") {
    if (std::exchange(call.has_message, true)) return Error{Code::bad_request, "call", "one message", "several"};
    call.message = message;
    return {};
  }
  transport::Observation piece;
  if (!piece.ParseFromArray(message.data(), static_cast<int>(message.size())))
    return Error{Code::bad_request, "Observation", "LeRobot's message", "other bytes"};
  if (piece.transfer_state() == transport::TRANSFER_BEGIN) call.message.clear();
  if (piece.transfer_state() == transport::TRANSFER_UNKNOWN)
    return Error{Code::bad_request, "transfer_state", "begin, middle or end", "unknown"};
  if (call.message.size() + piece.data().size() > shared_.limits.message)
    return Error{Code::too_large, "Observation", fmt::format("at most {} bytes", shared_.limits.message), "more"};
  if (call.message.empty()) {
    call.message = std::move(*piece.mutable_data());
  } else {
    call.message += piece.data();
  }
  call.is_whole = piece.transfer_state() == transport::TRANSFER_END;
  return {};
}

void Connection::end_stream(std::int32_t stream) {
  Call* const call = find(stream);
  if (call == nullptr) return;
  call->has_ended = true;
  if (call->is_whole || call->is_answered) return;
  if (!call->framed.empty() || !call->has_message)
    return refuse(*call, {Code::bad_request, "call", "a whole message", "one that is cut off"});
  call->is_whole = true;
  hand_over(*call);
}

void Connection::hand_over(Call& call) {
  shared_.hand_over(call, {call.id, peer_, call.method, std::move(call.message)});
}

/// While there are too many calls, ends connections: in the group with the most calls, the one whose calls began first.
/// Groups with no more calls than one connection may have count as equal.
void Shared::bound_calls() {
  const std::size_t most = limits.connections;
  while (n_call > most) {
    net::Standings all = standings();
    for (net::Standing& standing : all) standing.n_held = connections.at(standing.connection)->n_call();
    const auto chosen = net::to_interrupt(all, most, Rpcs::kMaxCalls, most, loop.now());
    if (!chosen) return;
    connections.at(*chosen)->drop("calls", fmt::format("more than {} at once, and these give way", most));
  }
}

void Shared::hand_over(Call& call, serve::lerobot::Rpc rpc) {
  const std::string& group = call.connection.group();
  auto turn = std::find_if(turns.begin(), turns.end(), [&](const auto& t) { return t.first == group; });
  if (turn == turns.end()) turn = turns.insert(turns.end(), {group, {}});
  turn->second.push_back(std::move(rpc));
  handle_later();
}

/// Handles one call at a time, so that every socket gets its turn in between.
void Shared::handle_later() {
  if (turns.empty() || std::exchange(is_handling, true)) return;
  boost::asio::post(loop.context(), [this] {
    is_handling = false;
    try {
      handle_next();
    } catch (const std::exception&) {  // no memory for an answer; the client times out
    }
    handle_later();
  });
}

void Shared::handle_next() {
  serve::lerobot::Rpc rpc = std::move(turns.front().second.front());
  turns.front().second.pop_front();
  if (turns.front().second.empty()) {
    turns.pop_front();
  } else {
    turns.splice(turns.end(), turns, turns.begin());
  }
  const auto call = calls.find(rpc.id);
  if (call == calls.end()) return;  // its connection ended
  call->second->connection.received(*call->second);
  call->second->is_handed_over = true;
  handler->called(std::move(rpc));
}

}  // namespace vla::door
