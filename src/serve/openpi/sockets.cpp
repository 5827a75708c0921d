// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/openpi/sockets.h"

#include <fmt/format.h>

#include <array>
#include <boost/asio/dispatch.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <boost/beast/core/flat_buffer.hpp>
#include <boost/beast/http/empty_body.hpp>
#include <boost/beast/http/parser.hpp>
#include <boost/beast/http/read.hpp>
#include <boost/beast/http/string_body.hpp>
#include <boost/beast/http/write.hpp>
#include <boost/beast/websocket/rfc6455.hpp>
#include <boost/beast/websocket/stream.hpp>
#include <deque>
#include <exception>
#include <optional>
#include <type_traits>
#include <utility>

#include "net/listener.h"
#include "net/sweeper.h"
#include "net/tcp.h"
#include "serve/token.h"

namespace vla::serve::openpi {
namespace {

namespace asio = boost::asio;
namespace beast = boost::beast;
namespace http = boost::beast::http;
namespace websocket = boost::beast::websocket;
using asio::ip::tcp;
using boost::system::error_code;

constexpr std::size_t kMaxHeader = 8192;
constexpr std::size_t kPiece = 256 << 10;  // maximum bytes of one read
// Timeouts in sweeps, one per second: for the handshake, without a sign of life, before a ping, for the close.
constexpr int kHandshakePatience = 10, kSilencePatience = 60, kPingAfter = 20, kClosePatience = 5;

using Request = http::request<http::empty_body>;
using Response = http::response<http::string_body>;

Response plain(const Request& request, http::status status, std::string body) {
  Response response(status, request.version());
  response.set(http::field::content_type, "text/plain; charset=utf-8");
  response.keep_alive(false);
  response.body() = std::move(body);
  response.prepare_payload();
  return response;
}

/// When the server ends a connection, it reads and discards what the peer still sends, so that the peer gets the frame
/// with the reason: closing with unread bytes resets a TCP connection. The sweeps bound the time.
struct Socket : tcp::socket {
  explicit Socket(tcp::socket socket) : tcp::socket(std::move(socket)) {}
  std::array<char, 4096> unread;
};

template <class Handler>
struct ReadOver {
  Socket& socket;
  Handler handler;

  void operator()(error_code error, std::size_t = 0) {
    if (error) return handler(error == asio::error::eof ? error_code() : error);
    const auto room = asio::buffer(socket.unread);
    socket.async_read_some(room, std::move(*this));
  }
};

/// Beast calls this once the close frame is sent. Beast's own version for a tcp::socket stops after the first bytes.
template <class Handler>
void async_teardown(beast::role_type, Socket& socket, Handler&& handler) {
  error_code ignored;
  socket.shutdown(tcp::socket::shutdown_send, ignored);
  ReadOver<std::decay_t<Handler>>{socket, std::forward<Handler>(handler)}({});
}

class Connection;

/// The common state of the connections.
struct Shared : net::Connections<Connection> {
  std::string api_key;
  Sockets::Handler* handler = nullptr;
};

class Connection : public std::enable_shared_from_this<Connection> {
 public:
  Connection(Shared& shared, tcp::socket socket, Peer peer)
      : shared_(shared),
        peer_(std::move(peer)),
        group_(net::group_of(peer_.address)),
        stream_(Socket(std::move(socket))) {
    parser_.header_limit(kMaxHeader);
    stream_.read_message_max(shared.limits.message);
    stream_.auto_fragment(false);
    stream_.control_callback([this](websocket::frame_type, beast::string_view) { silent_ = 0; });
  }

  void start() {
    guard([this] {
      http::async_read_header(stream_.next_layer(), buffer_, parser_,
                              [self = shared_from_this()](error_code error, std::size_t) {
                                if (error) return self->close();
                                self->guard([&] { self->answer_http(); });
                              });
    });
  }
  void send(std::string message, bool is_text) {
    guard([&] {
      is_failed_ = is_failed_ || is_text;
      out_.push_back({std::move(message), is_text});
      if (out_.size() == 1) write();
    });
  }
  void drop(const char* why, const std::string& detail) {
    if (is_closed_) return;
    const auto self = shared_from_this();
    close();
    shared_.handler->dropped(peer_, why, detail);
  }
  void close() {
    if (std::exchange(is_closed_, true)) return;
    error_code ignored;
    stream_.next_layer().shutdown(tcp::socket::shutdown_both, ignored);
    stream_.next_layer().close(ignored);
    shared_.has_freed = shared_.has_freed || n_held_ > 0 || buffer_.size() > 0;
    hold(0);
    shared_.connections.erase(peer_.connection);
  }
  void sweep() {
    guard([this] {
      ++age_, ++silent_;
      if (!is_open_ && age_ > kHandshakePatience) return drop("handshake", "none within 10 s");
      if (silent_ > (is_ending_ ? kClosePatience : kSilencePatience)) return drop("silent", "no sign of life");
      if (is_open_ && !is_ending_ && silent_ % kPingAfter == 0 && !is_pinging_) ping();
    });
  }
  net::Standing standing() const { return {peer_.connection, group_, is_open_, served_, began_, n_held_}; }
  bool has_answers() const { return !out_.empty(); }

 private:
  struct Out {
    std::string bytes;
    bool is_text;
  };

  /// Runs a step. An exception, such as for lack of memory, ends this connection only.
  template <class Step>
  void guard(Step step) {
    try {
      if (!is_closed_) step();
    } catch (const std::exception& exception) {
      drop("memory", exception.what());
    }
  }

  void answer_http() {
    const Request& request = parser_.get();
    if (request.target() == "/healthz" && !websocket::is_upgrade(request))
      return answer_http(plain(request, http::status::ok, "OK\n"));
    if (!websocket::is_upgrade(request))
      return answer_http(plain(request, http::status::upgrade_required, "a WebSocket is here, and /healthz\n"));
    // A web page in a browser on this machine could connect too; the browser then sends Origin.
    if (request.count(http::field::origin) != 0)
      return answer_http(plain(request, http::status::forbidden, "not for web pages\n"));
    const auto given = request[http::field::authorization];
    if (!shared_.api_key.empty() && !is_same_secret({given.data(), given.size()}, "Api-Key " + shared_.api_key))
      return answer_http(plain(request, http::status::unauthorized, "another Api-Key is needed\n"));
    stream_.async_accept(request, [self = shared_from_this()](error_code error) {
      if (error) return self->close();
      self->guard([&] { self->open(); });
    });
  }
  void answer_http(Response response) {
    response_ = std::move(response);
    http::async_write(stream_.next_layer(), response_, [self = shared_from_this()](error_code, std::size_t) {
      error_code ignored;
      self->stream_.next_layer().shutdown(tcp::socket::shutdown_send, ignored);
      self->close();
    });
  }

  void open() {
    is_open_ = true;
    buffer_.clear();
    stream_.binary(true);
    send(shared_.handler->greeting(), false);
    read();
  }

  /// Reads also while a request is in progress, so that pings are answered.
  void read() {
    stream_.async_read_some(buffer_, kPiece, [self = shared_from_this()](error_code error, std::size_t) {
      if (error == websocket::error::message_too_big)
        return self->drop("size", fmt::format("more than {} bytes", self->shared_.limits.message));
      if (error) return self->close();
      self->guard([&] { self->handle(); });
    });
  }
  void handle() {
    silent_ = 0;
    if (n_held_ == 0) began_ = shared_.loop.now();
    hold(buffer_.size());
    shared_.evict_slow_uploads();
    if (is_closed_) return;
    if (!stream_.is_message_done()) return read();
    is_waiting_ = true;
    next();
  }
  /// Handles the complete message, unless another one is in progress.
  void next() {
    if (!is_waiting_ || is_busy_ || is_failed_) return;
    is_waiting_ = false;
    is_busy_ = true;
    served_ = shared_.loop.now();
    const auto data = buffer_.data();
    std::string message(static_cast<const char*>(data.data()), data.size());
    buffer_.consume(buffer_.size());
    if (buffer_.capacity() > 2 * kPiece) buffer_.shrink_to_fit();  // frees the buffer of a large message
    hold(0);
    shared_.handler->received(peer_, std::move(message), stream_.got_text());
    if (!is_closed_) read();
  }

  void write() {
    stream_.text(out_.front().is_text);
    stream_.async_write(asio::buffer(out_.front().bytes), [self = shared_from_this()](error_code error, std::size_t) {
      if (error) return self->close();
      const bool was_text = self->out_.front().is_text;
      self->out_.pop_front();
      self->guard([&] {
        if (was_text) return self->end();
        if (std::exchange(self->is_greeted_, true)) self->answered();
        if (!self->out_.empty()) self->write();
        self->next();
      });
    });
  }
  void answered() {
    is_busy_ = false;
    peer_.total_ms = std::chrono::duration<double, std::milli>(shared_.loop.now() - served_).count();
  }
  /// Closes with the reference's code and reason.
  void end() {
    is_ending_ = true;
    silent_ = 0;
    stream_.async_close(
        {websocket::close_code::internal_error, "Internal server error. Traceback included in previous frame."},
        [self = shared_from_this()](error_code) { self->close(); });
  }
  void ping() {
    is_pinging_ = true;
    stream_.async_ping({}, [self = shared_from_this()](error_code error) {
      self->is_pinging_ = false;
      if (error) self->close();
    });
  }

  void hold(std::size_t n) {
    shared_.n_held += n - n_held_;
    n_held_ = n;
  }

  Shared& shared_;
  Peer peer_;
  const std::string group_;  // group of the peer's address
  websocket::stream<Socket> stream_;
  beast::flat_buffer buffer_;  // the header, then the message that is being received or that waits
  http::request_parser<http::empty_body> parser_;
  Response response_;
  std::deque<Out> out_;  // the first one is being sent
  Clock::time_point began_ = peer_.since, served_ = {};
  int age_ = 0, silent_ = 0;  // sweeps since it connected, since a sign of life
  std::size_t n_held_ = 0;
  bool is_open_ = false, is_greeted_ = false, is_busy_ = false, is_waiting_ = false;
  bool is_failed_ = false, is_ending_ = false, is_closed_ = false, is_pinging_ = false;
};

}  // namespace

class Sockets::All : public Shared {
 public:
  All(net::Loop& its_loop, const Limits& its_limits, std::string its_key)
      : Shared{{its_loop, its_limits}, std::move(its_key)} {}
  ~All() { close_all(); }

  Result<std::string> bind(const std::string& address, const char* option, bool insecure) {
    return net::bind_tcp(listener_, loop.context(), address, option, insecure);
  }

  void begin(Handler& its_handler) {
    handler = &its_handler;
    listener_->listen([this](tcp::socket socket) { add(std::move(socket)); });
    sweeper_.turn([this] { sweep_all(); });
  }

 private:
  void add(tcp::socket socket) {
    error_code gone;
    socket.set_option(tcp::no_delay(true), gone);
    const auto endpoint = socket.remote_endpoint(gone);
    Peer peer{++n_connection_, gone ? "" : endpoint.address().to_string(), loop.now()};
    const auto connection = std::make_shared<Connection>(*this, std::move(socket), std::move(peer));
    connections.emplace(n_connection_, connection);
    connection->start();
    evict_idle();
  }

  std::optional<net::Listener<tcp>> listener_;
  net::Sweeper sweeper_{loop};
  std::uint64_t n_connection_ = 0;
};

Sockets::Sockets(net::Loop& loop, const Limits& limits, std::string api_key)
    : all_(std::make_unique<All>(loop, limits, std::move(api_key))) {}
Sockets::~Sockets() = default;
Result<std::string> Sockets::bind(const std::string& address, const char* option, bool insecure) {
  return all_->bind(address, option, insecure);
}
void Sockets::begin(Handler& handler) { all_->begin(handler); }
void Sockets::send(std::uint64_t connection, std::string message) {
  all_->answer(connection, [&](Connection& to) { to.send(std::move(message), false); });
}
void Sockets::fail(std::uint64_t connection, std::string text) {
  all_->answer(connection, [&](Connection& to) { to.send(std::move(text), true); });
}
void Sockets::drop(std::uint64_t connection) noexcept try {
  if (const auto found = all_->find(connection)) found->drop("memory", "none for its request");
} catch (const std::exception&) {  // no memory to report it
}
bool Sockets::has_answers() const { return all_->has_answers(); }

}  // namespace vla::serve::openpi
