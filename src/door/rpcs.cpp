// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "door/rpcs.h"

#include "door/connection.h"
#include "net/listener.h"
#include "net/sweeper.h"

namespace vla::door {
namespace {

namespace asio = boost::asio;
using asio::ip::tcp;
using boost::system::error_code;
using serve::lerobot::Peer;

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
    nghttp2_option_set_no_closed_streams(option_, 1);  // nghttp2 would keep some for priorities
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
