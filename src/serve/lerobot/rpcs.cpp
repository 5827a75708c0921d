// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/lerobot/rpcs.h"

#include <fmt/format.h>
#include <grpcpp/generic/async_generic_service.h>
#include <grpcpp/grpcpp.h>
#include <grpcpp/resource_quota.h>
#include <grpcpp/support/proto_buffer_reader.h>

#include <atomic>
#include <boost/asio/io_context.hpp>
#include <boost/asio/post.hpp>
#include <map>
#include <mutex>

#include "base/clock.h"
#include "base/printable.h"
#include "net/sweeper.h"
#include "serve/lerobot/async_inference.pb.h"

namespace vla::serve::lerobot {
namespace {

constexpr int kPiece = static_cast<int>(Rpcs::kMaxPiece);
constexpr int kReadAtOnce = 64 << 10;
constexpr int kHandshakeMs = 10'000, kKeepaliveMs = 20'000;
constexpr auto kReceiptPatience = std::chrono::seconds(60);

grpc::StatusCode status_of(Code code) {
  switch (code) {
    case Code::bad_request:
    case Code::bad_observation:
    case Code::too_large:
      return grpc::StatusCode::INVALID_ARGUMENT;
    case Code::incompatible:
      return grpc::StatusCode::FAILED_PRECONDITION;
    case Code::unsupported:
      return grpc::StatusCode::UNIMPLEMENTED;
    case Code::busy:
    case Code::out_of_memory:
      return grpc::StatusCode::RESOURCE_EXHAUSTED;
    case Code::late:
    case Code::superseded:
      return grpc::StatusCode::ABORTED;
    case Code::shutting_down:
      return grpc::StatusCode::UNAVAILABLE;
    default:
      return grpc::StatusCode::INTERNAL;
  }
}

grpc::Status status_of(const Error& error) {
  return {status_of(error.code), fmt::format("{}: {}", code_name(error.code), printable(error.message()))};
}

}  // namespace

/// The common state of all calls. gRPC's threads and the loop's use it.
class Rpcs::All : public grpc::CallbackGenericService, Connections::Handler {
 public:
  class Call;
  All(net::Loop& loop, const Limits& limits)
      : loop_(loop), limits_(limits), connections_(loop, limits), sweeper_(loop) {}
  ~All() override {
    std::map<std::uint64_t, Call*> left;
    {
      const std::lock_guard lock(mutex_);
      is_closed_ = true;
      left.swap(live_);
      n_leaving_ += left.size();
    }
    for (const auto& [id, call] : left) end(*call, shutting_down());
    if (server_) server_->Shutdown(std::chrono::system_clock::now() + std::chrono::seconds(1));
  }

  Result<std::string> bind(const std::string& address, const char* option, bool insecure) {
    VLA_TRY(std::string bound, connections_.bind(address, option, insecure));
    grpc::ResourceQuota quota;
    quota.Resize(limits_.receipt + (16u << 20));
    grpc::ServerBuilder builder;
    acceptor_ = builder.experimental().AddExternalConnectionAcceptor(
        grpc::ServerBuilder::experimental_type::ExternalConnectionType::FROM_FD, grpc::InsecureServerCredentials());
    builder.RegisterCallbackGenericService(this);
    builder.SetResourceQuota(quota);
    builder.SetMaxReceiveMessageSize(kPiece);
    builder.AddChannelArgument(GRPC_ARG_MAX_CONCURRENT_STREAMS, static_cast<int>(Connections::kMaxCalls));
    builder.AddChannelArgument(GRPC_ARG_SERVER_HANDSHAKE_TIMEOUT_MS, kHandshakeMs);
    // Frames of cameras come at once, not by turns of 64 kB.
    builder.AddChannelArgument(GRPC_ARG_HTTP2_STREAM_LOOKAHEAD_BYTES, kPiece);
    builder.AddChannelArgument(GRPC_ARG_HTTP2_MAX_FRAME_SIZE, kPiece);
    builder.AddChannelArgument(GRPC_ARG_HTTP2_BDP_PROBE, 0);
    builder.AddChannelArgument(GRPC_ARG_TCP_READ_CHUNK_SIZE, kReadAtOnce);
    builder.AddChannelArgument(GRPC_ARG_TCP_MIN_READ_CHUNK_SIZE, kReadAtOnce);
    builder.AddChannelArgument(GRPC_ARG_KEEPALIVE_TIME_MS, kKeepaliveMs);
    builder.AddChannelArgument(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, kKeepaliveMs);
    builder.AddChannelArgument(GRPC_ARG_KEEPALIVE_PERMIT_WITHOUT_CALLS, 1);
    server_ = builder.BuildAndStart();
    if (!server_) return Error{Code::io, option, "a server of gRPC", "none", "report this"};
    return bound;
  }

  void begin(Rpcs::Handler& handler) {
    handler_ = &handler;
    connections_.begin(*this);
    sweeper_.turn([this] { sweep(); });
  }
  bool has_answers() const { return n_leaving_ > 0; }

  grpc::ServerGenericBidiReactor* CreateReactor(grpc::GenericCallbackServerContext* context) override;
  /// Takes a call out, which then has to be ended. Null where that was done.
  Call* take(std::uint64_t id) {
    const std::lock_guard lock(mutex_);
    const auto found = live_.find(id);
    if (found == live_.end()) return nullptr;
    Call* const call = found->second;
    live_.erase(found);
    ++n_leaving_;
    return call;
  }
  static void end(Call& call, const Error& error);
  void hand_over(Rpc rpc) {
    boost::asio::post(loop_.context(), [this, rpc = std::move(rpc)]() mutable { handler_->called(std::move(rpc)); });
  }
  void cancelled(std::uint64_t id) {
    boost::asio::post(loop_.context(), [this, id] { handler_->cancelled(id); });
  }

  net::Loop& loop_;
  const Limits limits_;
  Connections connections_;
  std::atomic<std::size_t> n_leaving_ = 0;  // calls that end

 private:
  void came(int descriptor) override {
    grpc::experimental::ExternalConnectionAcceptor::NewConnectionParameters connection;
    connection.fd = descriptor;
    acceptor_->HandleNewConnection(&connection);
  }
  void ended(const Peer& peer, const std::string& why, const std::string& detail) override {
    handler_->ended(peer, why, detail);
  }
  static Error shutting_down() { return {Code::shutting_down, "call", "", "the server stops"}; }
  void sweep();

  net::Sweeper sweeper_;
  Rpcs::Handler* handler_ = nullptr;
  std::mutex mutex_;
  std::map<std::uint64_t, Call*> live_;
  std::uint64_t n_call_ = 0;
  bool is_closed_ = false;
  std::unique_ptr<grpc::experimental::ExternalConnectionAcceptor> acceptor_;
  std::unique_ptr<grpc::Server> server_;
};

/// One call. gRPC does not destroy it before it was ended.
class Rpcs::All::Call final : public grpc::ServerGenericBidiReactor {
 public:
  Call(All& all, std::uint64_t id, Peer peer, const grpc::GenericCallbackServerContext& context)
      : all_(all), id_(id), connection_(peer.connection) {
    rpc_.id = id;
    rpc_.peer = std::move(peer);
    rpc_.method = context.method().substr(context.method().rfind('/') + 1);
  }
  void start() { StartRead(&in_); }
  void answer(const std::string& message) {
    const grpc::Slice slice(message);
    out_ = grpc::ByteBuffer(&slice, 1);
    StartWriteAndFinish(&out_, {}, grpc::Status::OK);
  }
  void refuse(const Error& error) { Finish(status_of(error)); }
  bool is_stuck(Clock::time_point now) const { return !is_whole_ && now - began_ > kReceiptPatience; }

 private:
  void OnReadDone(bool ok) override {
    try {
      if (!ok) return is_whole_ ? void() : fail({Code::bad_request, "call", "a whole message", "one that is cut off"});
      if (Status valid = take_piece(); !valid) return fail(valid.error());
      if (!is_whole_) return StartRead(&in_);
      all_.connections_.received(connection_, std::exchange(n_held_, 0), true);
      all_.hand_over(std::move(rpc_));
    } catch (const std::exception&) {
      fail({Code::out_of_memory, "call", "", "no memory for it"});
    }
  }
  void OnCancel() override { all_.cancelled(id_); }
  void OnDone() override {
    all_.connections_.received(connection_, n_held_, false);
    all_.connections_.call_ends(connection_);
    --all_.n_leaving_;
    delete this;
  }

  Status take_piece() {
    if (rpc_.method != "SendObservations") {
      grpc::Slice slice;
      if (!in_.DumpToSingleSlice(&slice).ok()) return Error{Code::out_of_memory, "call", "", "no memory for it"};
      rpc_.message.assign(reinterpret_cast<const char*>(slice.begin()), slice.size());
      is_whole_ = true;
      return {};
    }
    grpc::ProtoBufferReader reader(&in_);
    transport::Observation piece;
    if (!reader.status().ok() || !piece.ParseFromZeroCopyStream(&reader))
      return Error{Code::bad_request, "Observation", "LeRobot's message", "other bytes"};
    if (piece.transfer_state() == transport::TRANSFER_BEGIN) rpc_.message.clear();
    if (piece.transfer_state() == transport::TRANSFER_UNKNOWN)
      return Error{Code::bad_request, "transfer_state", "begin, middle or end", "unknown"};
    if (rpc_.message.size() + piece.data().size() > all_.limits_.message)
      return Error{Code::too_large, "Observation", fmt::format("at most {} bytes", all_.limits_.message), "more"};
    n_held_ += piece.data().size();
    all_.connections_.receives(connection_, piece.data().size());
    if (rpc_.message.empty()) {
      rpc_.message = std::move(*piece.mutable_data());
    } else {
      rpc_.message += piece.data();
    }
    is_whole_ = piece.transfer_state() == transport::TRANSFER_END;
    return {};
  }
  void fail(const Error& error) {
    if (all_.take(id_) != nullptr) refuse(error);
  }

  All& all_;
  Rpc rpc_;
  const std::uint64_t id_, connection_;
  const Clock::time_point began_ = all_.loop_.now();
  grpc::ByteBuffer in_, out_;
  std::size_t n_held_ = kMaxPiece;  // the one that gRPC has a part of, and those before
  std::atomic<bool> is_whole_ = false;
};

grpc::ServerGenericBidiReactor* Rpcs::All::CreateReactor(grpc::GenericCallbackServerContext* context) {
  const std::optional<Peer> peer = connections_.call_begins(context->peer(), kMaxPiece);
  std::optional<Error> refused;
  Call* call = nullptr;
  {
    const std::lock_guard lock(mutex_);
    call = new Call(*this, ++n_call_, peer.value_or(Peer{}), *context);
    if (is_closed_) refused = shutting_down();
    if (!peer) refused = Error{Code::busy, "connection", "one that is open", "one that gave way"};
    if (refused) {
      ++n_leaving_;
    } else {
      live_.emplace(n_call_, call);
    }
  }
  if (refused) {
    call->refuse(*refused);
  } else {
    call->start();
  }
  return call;
}

void Rpcs::All::end(Call& call, const Error& error) { call.refuse(error); }

void Rpcs::All::sweep() {
  std::vector<std::uint64_t> stuck;
  {
    const std::lock_guard lock(mutex_);
    for (const auto& [id, call] : live_)
      if (call->is_stuck(loop_.now())) stuck.push_back(id);
  }
  for (const std::uint64_t id : stuck)
    if (Call* const call = take(id)) end(*call, {Code::late, "call", "a whole message within 60 s", "a part"});
}

Rpcs::Rpcs(net::Loop& loop, const Limits& limits) : all_(std::make_unique<All>(loop, limits)) {}
Rpcs::~Rpcs() = default;
Result<std::string> Rpcs::bind(const std::string& address, const char* option, bool insecure) {
  return all_->bind(address, option, insecure);
}
void Rpcs::begin(Handler& handler) { all_->begin(handler); }
void Rpcs::answer(std::uint64_t id, const std::string& message) {
  if (All::Call* const call = all_->take(id)) call->answer(message);
}
void Rpcs::refuse(std::uint64_t id, const Error& error) noexcept try {
  if (All::Call* const call = all_->take(id)) call->refuse(error);
} catch (const std::exception&) {  // no memory for the words: the client's own deadline ends it
}
bool Rpcs::has_answers() const { return all_->has_answers(); }

}  // namespace vla::serve::lerobot
