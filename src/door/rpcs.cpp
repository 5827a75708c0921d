// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Source: gRPC, doc/PROTOCOL-HTTP2.md.
#include "door/rpcs.h"

#include <fmt/format.h>
#include <nghttp2/nghttp2.h>

#include <boost/asio/ip/tcp.hpp>
#include <boost/asio/post.hpp>
#include <boost/asio/write.hpp>
#include <cstring>
#include <deque>
#include <exception>
#include <list>

#include "base/printable.h"
#include "door/floods.h"
#include "net/listener.h"
#include "net/sweeper.h"
#include "serve/lerobot/async_inference.pb.h"

namespace vla::door {
namespace {

namespace asio = boost::asio;
using asio::ip::tcp;
using boost::system::error_code;
using serve::lerobot::Peer;
using serve::lerobot::Rpc;

constexpr std::size_t kReadAtOnce = 256 << 10, kWriteAtOnce = 256 << 10;
constexpr std::size_t kCallCost = 4 << 10;    // bytes that a call counts for before any data arrives
constexpr std::uint32_t kMaxFrame = 1 << 20;  // large, so that camera frames arrive in few pieces
// HTTP/2 windows of a stream and a connection; bytes are limited here instead
constexpr std::int32_t kWindow = 16 << 20;
constexpr std::size_t kMaxOutbound = 1000;        // queued frames for a peer that does not read
constexpr std::size_t kMaxHeaderList = 16 << 10;  // decompressed header bytes per call
constexpr std::size_t kMaxWords = 2000;           // of an error
// Timeouts in seconds: until the first call; without a sign of life; before a ping asks for one; for a peer that does
// not read.
constexpr int kHandshakePatience = 10, kSilencePatience = 60, kPingAfter = 20, kStallPatience = 10;
constexpr auto kReceiptPatience = std::chrono::seconds(60);

/// gRPC status codes.
int status_of(Code code) {
  switch (code) {
    case Code::bad_request:
    case Code::bad_observation:
    case Code::too_large:
      return 3;  // INVALID_ARGUMENT
    case Code::incompatible:
      return 9;  // FAILED_PRECONDITION
    case Code::unsupported:
      return 12;  // UNIMPLEMENTED
    case Code::busy:
    case Code::out_of_memory:
      return 8;  // RESOURCE_EXHAUSTED
    case Code::late:
    case Code::superseded:
      return 10;  // ABORTED
    case Code::shutting_down:
      return 14;  // UNAVAILABLE
    default:
      return 13;  // INTERNAL
  }
}

std::string percent_encoded(std::string_view text) {
  std::string out;
  for (const char c : text.substr(0, kMaxWords)) {
    if (c >= ' ' && c <= '~' && c != '%') {
      out += c;
    } else {
      out += fmt::format("%{:02X}", static_cast<unsigned char>(c));
    }
  }
  return out;
}

/// nghttp2 copies both.
nghttp2_nv header(std::string_view name, std::string_view value) {
  const auto bytes = [](std::string_view text) {
    return reinterpret_cast<std::uint8_t*>(const_cast<char*>(text.data()));
  };
  return {bytes(name), bytes(value), name.size(), value.size(), NGHTTP2_NV_FLAG_NONE};
}

class Connection;

/// A call, from its headers until its stream closes.
struct Call {
  Connection& connection;
  std::int32_t stream = 0;
  std::uint64_t id = 0;
  Clock::time_point began = {};
  std::string method = {}, content_type = {};
  std::size_t header_bytes = 0;
  std::string framed = {};   // a partial gRPC message
  std::string message = {};  // the complete messages
  bool has_message = false;
  std::size_t n_held = 0;
  bool is_whole = false, is_handed_over = false, is_answered = false, has_ended = false;
  std::string answer = {};
  std::size_t n_sent = 0;
};

struct Shared : net::Connections<Connection> {
  Rpcs::Handler* handler = nullptr;
  std::vector<std::uint8_t> in = std::vector<std::uint8_t>(kReadAtOnce);  // of the connection that is being read
  std::map<std::uint64_t, Call*> calls = {};                              // not answered yet
  std::uint64_t n_id = 0;
  std::size_t n_call = 0;
  bool is_stopping = false, is_handling = false;

  void bound_calls();
  void hand_over(Call& call, Rpc rpc);
  void handle_later();
  void handle_next();

  /// Complete calls are handled one after the other, in turn by group of peers.
  std::list<std::pair<std::string, std::deque<Rpc>>> turns = {};
};

class Connection : public std::enable_shared_from_this<Connection> {
 public:
  Connection(Shared& shared, tcp::socket socket, Peer peer)
      : peer_(std::move(peer)), group_(net::group_of(peer_.address)), shared_(shared), socket_(std::move(socket)) {}
  ~Connection() { nghttp2_session_del(session_); }

  void start(const nghttp2_session_callbacks* callbacks, const nghttp2_option* option) {
    guard([&] {
      const nghttp2_settings_entry settings[] = {{NGHTTP2_SETTINGS_MAX_CONCURRENT_STREAMS, Rpcs::kMaxCalls},
                                                 {NGHTTP2_SETTINGS_INITIAL_WINDOW_SIZE, kWindow},
                                                 {NGHTTP2_SETTINGS_MAX_FRAME_SIZE, kMaxFrame},
                                                 {NGHTTP2_SETTINGS_MAX_HEADER_LIST_SIZE, kMaxHeaderList}};
      if (nghttp2_session_server_new2(&session_, callbacks, this, option) != 0 ||
          nghttp2_submit_settings(session_, NGHTTP2_FLAG_NONE, settings, std::size(settings)) != 0 ||
          nghttp2_session_set_local_window_size(session_, NGHTTP2_FLAG_NONE, 0, kWindow) != 0)
        throw std::bad_alloc();
      flush();
      read();
    });
  }
  void drop(const char* why, const std::string& detail) {
    if (!is_closed_) close(why, detail);
  }
  void close(const char* why = "", const std::string& detail = {}) {
    if (std::exchange(is_closed_, true)) return;
    const auto self = shared_from_this();
    error_code ignored;
    socket_.close(ignored);
    while (!calls_.empty()) end(*calls_.begin()->second);
    shared_.connections.erase(peer_.connection);
    shared_.handler->closed(peer_, why, detail);
  }
  void sweep() {
    guard([this] {
      ++age_, ++silent_;
      if (!is_open_ && age_ > kHandshakePatience) return drop("handshake", "none within 10 s");
      if (silent_ > kSilencePatience) return drop("silent", "no sign of life");
      if (is_writing_ && ++stalled_ > kStallPatience) return drop("stalled", "it does not read");
      refuse_late();
      if (is_open_ && silent_ % kPingAfter == 0) nghttp2_submit_ping(session_, NGHTTP2_FLAG_NONE, nullptr);
      flush();
    });
  }
  net::Standing standing() const { return {peer_.connection, group_, is_open_, served_, began_, n_held_}; }
  std::size_t n_call() const { return calls_.size(); }
  bool has_answers() const {
    return is_writing_ ||
           std::any_of(calls_.begin(), calls_.end(), [](const auto& c) { return c.second->is_answered; });
  }
  const std::string& group() const { return group_; }

  void answer(Call& call, const std::string& message) {
    guard([&] {
      if (!take(call)) return;
      const auto size = static_cast<std::uint32_t>(message.size());
      call.answer = {'\0', static_cast<char>(size >> 24), static_cast<char>(size >> 16), static_cast<char>(size >> 8),
                     static_cast<char>(size)};
      call.answer += message;
      const nghttp2_nv headers[] = {header(":status", "200"), header("content-type", "application/grpc")};
      nghttp2_data_provider body = {};
      body.source.ptr = &call;
      body.read_callback = read_answer;
      nghttp2_submit_response(session_, call.stream, headers, std::size(headers), &body);
      flush();
    });
  }
  void refuse(Call& call, const Error& error) {
    guard([&] {
      if (!take(call)) return;
      const std::string status = std::to_string(status_of(error.code));
      const std::string words =
          percent_encoded(fmt::format("{}: {}", code_name(error.code), printable(error.message())));
      const nghttp2_nv headers[] = {header(":status", "200"), header("content-type", "application/grpc"),
                                    header("grpc-status", status), header("grpc-message", words)};
      nghttp2_submit_response(session_, call.stream, headers, std::size(headers), nullptr);
      flush();
    });
  }

  // Callbacks of the library. None may throw through it.
  template <class Step>
  static int called(void* connection, Step step) {
    auto& self = *static_cast<Connection*>(connection);
    try {
      if (!self.is_closed_) step(self);
      return self.is_closed_ ? NGHTTP2_ERR_CALLBACK_FAILURE : 0;
    } catch (const std::exception&) {
      self.drop("memory", "none for what it sent");
      return NGHTTP2_ERR_CALLBACK_FAILURE;
    }
  }
  void begin_call(std::int32_t stream);
  void take_header(std::int32_t stream, std::string_view name, std::string_view value);
  void end_headers(std::int32_t stream, bool is_last);
  void take_data(std::int32_t stream, std::string_view data);
  void end_stream(std::int32_t stream);
  void sent_last(std::int32_t stream) {
    if (Call* const call = find(stream); call != nullptr && !call->has_ended)
      nghttp2_submit_rst_stream(session_, NGHTTP2_FLAG_NONE, stream, NGHTTP2_NO_ERROR);
  }
  void closed(std::int32_t stream) {
    if (Call* const call = find(stream)) end(*call);
  }
  void received(Call& call) {
    hold(call, -static_cast<std::ptrdiff_t>(call.n_held));
    served_ = shared_.loop.now();
  }

 private:
  /// Running out of memory here ends this connection only.
  template <class Step>
  void guard(Step step) noexcept {
    const auto self = shared_from_this();
    try {
      if (!is_closed_) step();
    } catch (const std::exception& exception) {
      try {
        drop("memory", exception.what());
      } catch (const std::exception&) {  // closed before the handler was told of it
      }
    }
  }

  void read() {
    socket_.async_wait(tcp::socket::wait_read, [self = shared_from_this()](error_code error) {
      if (error) return self->close();
      self->guard([&] { self->receive(); });
    });
  }
  void receive() {
    error_code error;
    const std::size_t n = socket_.read_some(asio::buffer(shared_.in), error);
    if (error == asio::error::would_block) return read();
    if (error) return close();
    silent_ = 0;
    const std::span<const std::uint8_t> bytes(shared_.in.data(), n);
    if (const char* too_much = floods_.count(std::as_bytes(bytes), shared_.loop.now()))
      return drop("flood", fmt::format("too many {}", too_much));
    is_in_library_ = true;
    const auto used = nghttp2_session_mem_recv(session_, bytes.data(), bytes.size());
    is_in_library_ = false;
    if (is_closed_) return;
    if (used < 0) return drop("protocol", nghttp2_strerror(static_cast<int>(used)));
    if (nghttp2_session_get_outbound_queue_size(session_) > kMaxOutbound) return drop("stalled", "it does not read");
    shared_.evict_slow_uploads();
    if (is_closed_) return;
    flush();
    if (!is_closed_) read();
  }
  void flush() {
    if (is_writing_ || is_closed_ || is_in_library_) return;
    out_.clear();
    while (out_.size() < kWriteAtOnce) {
      const std::uint8_t* bytes = nullptr;
      is_in_library_ = true;
      const auto n = nghttp2_session_mem_send(session_, &bytes);
      is_in_library_ = false;
      if (is_closed_) return;
      if (n < 0) return drop("protocol", nghttp2_strerror(static_cast<int>(n)));
      if (n == 0) break;
      out_.append(reinterpret_cast<const char*>(bytes), static_cast<std::size_t>(n));
    }
    if (out_.empty()) {
      out_.shrink_to_fit();
      if (nghttp2_session_want_read(session_) == 0 && nghttp2_session_want_write(session_) == 0) close();
      return;
    }
    is_writing_ = true;
    asio::async_write(socket_, asio::buffer(out_), [self = shared_from_this()](error_code error, std::size_t) {
      self->is_writing_ = false;
      self->stalled_ = 0;
      if (error) return self->close();
      self->guard([&] { self->flush(); });
    });
  }
  static ssize_t read_answer(nghttp2_session* session, std::int32_t stream, std::uint8_t* to, std::size_t size,
                             std::uint32_t* flags, nghttp2_data_source* source, void*) {
    Call& call = *static_cast<Call*>(source->ptr);
    const std::size_t n = std::min(size, call.answer.size() - call.n_sent);
    std::memcpy(to, call.answer.data() + call.n_sent, n);
    call.n_sent += n;
    if (call.n_sent < call.answer.size()) return static_cast<ssize_t>(n);
    *flags |= NGHTTP2_DATA_FLAG_EOF | NGHTTP2_DATA_FLAG_NO_END_STREAM;
    const nghttp2_nv trailer = header("grpc-status", "0");
    if (nghttp2_submit_trailer(session, stream, &trailer, 1) != 0) return NGHTTP2_ERR_TEMPORAL_CALLBACK_FAILURE;
    return static_cast<ssize_t>(n);
  }

  Call* find(std::int32_t stream) {
    const auto found = calls_.find(stream);
    return found == calls_.end() ? nullptr : found->second.get();
  }
  /// Removes a call from those that wait for an answer.
  bool take(Call& call) {
    if (std::exchange(call.is_answered, true)) return false;
    shared_.calls.erase(call.id);
    hold(call, -static_cast<std::ptrdiff_t>(call.n_held));
    call.message = {}, call.framed = {};
    return true;
  }
  void end(Call& call) {
    const bool was_waiting = take(call) && call.is_handed_over;
    const std::uint64_t id = call.id;
    --shared_.n_call;
    calls_.erase(call.stream);
    if (was_waiting) shared_.handler->cancelled(id);
  }
  void hold(Call& call, std::ptrdiff_t n) {
    if (n_held_ == 0) began_ = shared_.loop.now();
    call.n_held += static_cast<std::size_t>(n);
    n_held_ += static_cast<std::size_t>(n);
    shared_.n_held += static_cast<std::size_t>(n);
  }
  void refuse_late() {
    std::vector<std::int32_t> late;
    for (const auto& [stream, call] : calls_)
      if (!call->is_whole && !call->is_answered && shared_.loop.now() - call->began > kReceiptPatience)
        late.push_back(stream);
    for (const std::int32_t stream : late)  // sending a refusal may end other calls
      if (Call* const call = find(stream)) refuse(*call, {Code::late, "call", "a whole message within 60 s", "a part"});
  }
  void take_frames(Call& call);
  Status take_message(Call& call, std::string_view message);
  void hand_over(Call& call);

  const Peer peer_;
  const std::string group_;
  Shared& shared_;
  tcp::socket socket_;
  nghttp2_session* session_ = nullptr;
  Floods floods_;
  std::map<std::int32_t, std::unique_ptr<Call>> calls_;
  std::string out_;
  std::size_t n_held_ = 0;
  Clock::time_point served_ = {}, began_ = {};
  // sweeps since it connected, since the last sign of life, since it last read our bytes
  int age_ = 0, silent_ = 0, stalled_ = 0;
  bool is_open_ = false, is_closed_ = false, is_writing_ = false;
  // Inside a callback nothing may be sent: the end of one call may answer another one.
  bool is_in_library_ = false;
};

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

void Shared::hand_over(Call& call, Rpc rpc) {
  const std::string& group = call.connection.group();
  auto turn = std::find_if(turns.begin(), turns.end(), [&](const auto& t) { return t.first == group; });
  if (turn == turns.end()) turn = turns.insert(turns.end(), {group, {}});
  turn->second.push_back(std::move(rpc));
  handle_later();
}

/// Handles one call at a time, so that every socket gets its turn in between.
void Shared::handle_later() {
  if (turns.empty() || std::exchange(is_handling, true)) return;
  asio::post(loop.context(), [this] {
    is_handling = false;
    try {
      handle_next();
    } catch (const std::exception&) {  // no memory for an answer; the client times out
    }
    handle_later();
  });
}

void Shared::handle_next() {
  Rpc rpc = std::move(turns.front().second.front());
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

int on_begin_headers(nghttp2_session*, const nghttp2_frame* frame, void* connection) {
  if (frame->hd.type != NGHTTP2_HEADERS || frame->headers.cat != NGHTTP2_HCAT_REQUEST) return 0;
  return Connection::called(connection, [&](Connection& c) { c.begin_call(frame->hd.stream_id); });
}
int on_header(nghttp2_session*, const nghttp2_frame* frame, const std::uint8_t* name, std::size_t n_name,
              const std::uint8_t* value, std::size_t n_value, std::uint8_t, void* connection) {
  const std::string_view key(reinterpret_cast<const char*>(name), n_name);
  const std::string_view text(reinterpret_cast<const char*>(value), n_value);
  return Connection::called(connection, [&](Connection& c) { c.take_header(frame->hd.stream_id, key, text); });
}
int on_frame(nghttp2_session*, const nghttp2_frame* frame, void* connection) {
  const bool is_last = (frame->hd.flags & NGHTTP2_FLAG_END_STREAM) != 0;
  return Connection::called(connection, [&](Connection& c) {
    if (frame->hd.type == NGHTTP2_HEADERS && frame->headers.cat == NGHTTP2_HCAT_REQUEST)
      return c.end_headers(frame->hd.stream_id, is_last);
    if ((frame->hd.type == NGHTTP2_DATA || frame->hd.type == NGHTTP2_HEADERS) && is_last)
      c.end_stream(frame->hd.stream_id);
  });
}
int on_data(nghttp2_session*, std::uint8_t, std::int32_t stream, const std::uint8_t* data, std::size_t size,
            void* connection) {
  const std::string_view bytes(reinterpret_cast<const char*>(data), size);
  return Connection::called(connection, [&](Connection& c) { c.take_data(stream, bytes); });
}
int on_sent(nghttp2_session*, const nghttp2_frame* frame, void* connection) {
  if (frame->hd.type != NGHTTP2_HEADERS || (frame->hd.flags & NGHTTP2_FLAG_END_STREAM) == 0) return 0;
  return Connection::called(connection, [&](Connection& c) { c.sent_last(frame->hd.stream_id); });
}
int on_closed(nghttp2_session*, std::int32_t stream, std::uint32_t, void* connection) {
  return Connection::called(connection, [&](Connection& c) { c.closed(stream); });
}

}  // namespace

class Rpcs::All : public Shared {
 public:
  All(net::Loop& its_loop, int descriptor, const net::ConnectionLimits& its_limits)
      : Shared{{its_loop, its_limits}}, listener_(its_loop.context(), family_of(descriptor), descriptor) {
    if (nghttp2_session_callbacks_new(&callbacks_) != 0 || nghttp2_option_new(&option_) != 0) throw std::bad_alloc();
    nghttp2_session_callbacks_set_on_begin_headers_callback(callbacks_, on_begin_headers);
    nghttp2_session_callbacks_set_on_header_callback(callbacks_, on_header);
    nghttp2_session_callbacks_set_on_frame_recv_callback(callbacks_, on_frame);
    nghttp2_session_callbacks_set_on_data_chunk_recv_callback(callbacks_, on_data);
    nghttp2_session_callbacks_set_on_frame_send_callback(callbacks_, on_sent);
    nghttp2_session_callbacks_set_on_stream_close_callback(callbacks_, on_closed);
    nghttp2_option_set_no_closed_streams(option_, 1);  // it would remember some for priorities
  }
  ~All() {
    nghttp2_option_del(option_);
    nghttp2_session_callbacks_del(callbacks_);
  }

  void begin(Handler& its_handler) {
    handler = &its_handler;
    listener_.listen([this](tcp::socket socket) { add(std::move(socket)); });
    sweeper_.turn([this] { sweep_all(); });
  }
  void stop() {
    is_stopping = true;
    listener_.stop();
    const std::map<std::uint64_t, Call*> left = calls;
    for (const auto& [id, call] : left)
      if (calls.contains(id)) call->connection.refuse(*call, {Code::shutting_down, "call", "", "the server stops"});
  }

 private:
  static tcp family_of(int descriptor) {
    sockaddr_storage address = {};
    socklen_t size = sizeof address;
    ::getsockname(descriptor, reinterpret_cast<sockaddr*>(&address), &size);
    return address.ss_family == AF_INET6 ? tcp::v6() : tcp::v4();
  }
  /// Treats an IPv4 address that is mapped into IPv6 as IPv4.
  static std::string address_of(const tcp::endpoint& endpoint) {
    const asio::ip::address address = endpoint.address();
    if (!address.is_v6() || !address.to_v6().is_v4_mapped()) return address.to_string();
    return asio::ip::make_address_v4(asio::ip::v4_mapped, address.to_v6()).to_string();
  }
  void add(tcp::socket socket) {
    error_code gone;
    socket.set_option(tcp::no_delay(true), gone);
    socket.non_blocking(true, gone);
    const tcp::endpoint endpoint = socket.remote_endpoint(gone);
    if (gone) return;
    const Peer peer{++n_connection_, address_of(endpoint), loop.now()};
    const auto connection = std::make_shared<Connection>(*this, std::move(socket), peer);
    connections.emplace(peer.connection, connection);
    handler->opened(peer);
    connection->start(callbacks_, option_);
    evict_idle();
  }

  net::Listener<tcp> listener_;
  net::Sweeper sweeper_{loop};
  std::uint64_t n_connection_ = 0;
  nghttp2_session_callbacks* callbacks_ = nullptr;
  nghttp2_option* option_ = nullptr;
};

Rpcs::Rpcs(net::Loop& loop, int descriptor, const net::ConnectionLimits& limits)
    : all_(std::make_unique<All>(loop, descriptor, limits)) {}
Rpcs::~Rpcs() = default;
void Rpcs::begin(Handler& handler) { all_->begin(handler); }
void Rpcs::answer(std::uint64_t id, const std::string& message) {
  if (const auto call = all_->calls.find(id); call != all_->calls.end())
    call->second->connection.answer(*call->second, message);
}
void Rpcs::refuse(std::uint64_t id, const Error& error) noexcept {
  if (const auto call = all_->calls.find(id); call != all_->calls.end())
    call->second->connection.refuse(*call->second, error);
}
void Rpcs::stop() { all_->stop(); }
void Rpcs::end() { all_->close_all(); }
bool Rpcs::has_answers() const { return all_->has_answers(); }

}  // namespace vla::door
