// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "door/connection.h"

#include <fmt/format.h>

#include <algorithm>
#include <boost/asio/write.hpp>

namespace vla::door {
namespace {

namespace asio = boost::asio;
using asio::ip::tcp;
using boost::system::error_code;

constexpr std::size_t kWriteAtOnce = 256 << 10;
constexpr std::uint32_t kMaxFrame = 1 << 20;  // large, so that camera frames arrive in few pieces
// HTTP/2 windows of a stream and a connection; bytes are limited here instead
constexpr std::int32_t kWindow = 16 << 20;
constexpr std::size_t kMaxOutbound = 1000;  // queued frames for a peer that does not read
// Timeouts in seconds: until the first call; without a sign of life; before a ping asks for one; for a peer that does
// not read.
constexpr int kHandshakePatience = 10, kSilencePatience = 60, kPingAfter = 20, kStallPatience = 10;

}  // namespace

Connection::Connection(Shared& shared, Socket socket, serve::lerobot::Peer peer)
    : peer_(std::move(peer)), group_(net::group_of(peer_.address)), shared_(shared), socket_(std::move(socket)) {}

Connection::~Connection() { nghttp2_session_del(session_); }

void Connection::start(const nghttp2_session_callbacks* callbacks, const nghttp2_option* option) {
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

void Connection::close(const char* why, const std::string& detail) {
  if (std::exchange(is_closed_, true)) return;
  const auto self = shared_from_this();
  error_code ignored;
  socket_.close(ignored);
  while (!calls_.empty()) end(*calls_.begin()->second);
  shared_.connections.erase(peer_.connection);
  shared_.handler->closed(peer_, why, detail);
}

void Connection::sweep() {
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

bool Connection::has_answers() const {
  return is_writing_ || std::any_of(calls_.begin(), calls_.end(), [](const auto& c) { return c.second->is_answered; });
}

void Connection::read() {
  socket_.async_wait(tcp::socket::wait_read, [self = shared_from_this()](error_code error) {
    if (error) return self->close();
    self->guard([&] { self->receive(); });
  });
}

void Connection::receive() {
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

void Connection::flush() {
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

}  // namespace vla::door
