// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "zmtp/hub.h"

#include <fmt/format.h>
#include <ifaddrs.h>
#include <net/if.h>
#include <unistd.h>

#include <algorithm>
#include <boost/asio/generic/stream_protocol.hpp>
#include <boost/asio/io_context.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <boost/asio/local/stream_protocol.hpp>
#include <boost/asio/post.hpp>
#include <boost/asio/write.hpp>
#include <cerrno>
#include <charconv>
#include <deque>
#include <exception>
#include <list>

#include "net/listener.h"
#include "net/sweeper.h"

namespace vla::zmtp {
namespace {

namespace asio = boost::asio;
using asio::ip::tcp;
using Local = asio::local::stream_protocol;
using boost::system::error_code;
using net::Standing;

constexpr std::size_t kMaxAnswers = 64;  // answers that a connection may leave unread
// unread bytes at which the hub stops reading from a connection; at twice as many it drops further answers
constexpr std::size_t kMaxUnread = 128 << 10;
constexpr int kTurn = 4;  // messages of a connection before others get a turn
constexpr int kHandshakePatience = 10, kSilencePatience = 15, kPingAfter = 5;  // in sweeps

/// The first address of an interface, IPv4 before IPv6.
std::optional<asio::ip::address> address_of_interface(const std::string& name) {
  ifaddrs* all = nullptr;
  if (getifaddrs(&all) != 0) return std::nullopt;
  std::optional<asio::ip::address> found;
  for (const ifaddrs* at = all; at != nullptr; at = at->ifa_next) {
    if (at->ifa_addr == nullptr || name != at->ifa_name) continue;
    if (at->ifa_addr->sa_family == AF_INET) {
      found = asio::ip::address_v4(ntohl(reinterpret_cast<const sockaddr_in*>(at->ifa_addr)->sin_addr.s_addr));
      break;
    }
    if (at->ifa_addr->sa_family != AF_INET6 || found) continue;
    const auto& v6 = *reinterpret_cast<const sockaddr_in6*>(at->ifa_addr);
    asio::ip::address_v6::bytes_type bytes;
    std::copy_n(v6.sin6_addr.s6_addr, bytes.size(), bytes.begin());
    found = asio::ip::address_v6(bytes, v6.sin6_scope_id);
  }
  freeifaddrs(all);
  return found;
}

/// Returns the address and port of HOST:PORT. HOST is an address, an IPv6 address in brackets, an interface, or `*`.
/// None if HOST is not an address and no interface with an address.
std::optional<tcp::endpoint> tcp_endpoint(const std::string& where) {
  const std::size_t colon = where.rfind(':');
  std::string host = where.substr(0, colon);
  unsigned short port = 0;
  std::from_chars(where.data() + colon + 1, where.data() + where.size(), port);
  if (host == "*") host = "0.0.0.0";
  if (host.starts_with('[') && host.ends_with(']')) host = host.substr(1, host.size() - 2);
  error_code not_an_address;
  const auto address = asio::ip::make_address(host, not_an_address);
  if (!not_an_address) return tcp::endpoint(address, port);
  const auto of_interface = address_of_interface(host);
  return of_interface ? std::optional(tcp::endpoint(*of_interface, port)) : std::nullopt;
}

std::string text_of(const tcp::endpoint& endpoint) {
  const std::string address = endpoint.address().to_string();
  return fmt::format("tcp://{}:{}", endpoint.address().is_v6() ? "[" + address + "]" : address, endpoint.port());
}

Error cannot_bind(const std::string& endpoint, const error_code& error) {
  switch (error.value()) {
    case EADDRINUSE:
      return {Code::io, endpoint, "a free address", "one that another program uses", "choose another with --bind"};
    case EADDRNOTAVAIL:
    case ENODEV:
      return {Code::io, endpoint, "an address of this machine", error.message(), "tcp://127.0.0.1:5555 is one"};
    default:
      return {Code::io, endpoint, "an address that can be bound", error.message()};
  }
}

std::string peer_of(tcp::socket& socket) {
  error_code gone;
  const auto endpoint = socket.remote_endpoint(gone);
  return gone ? "" : endpoint.address().to_string();
}

std::string peer_of(Local::socket& socket) {
  ucred user = {};
  socklen_t size = sizeof(user);
  if (getsockopt(socket.native_handle(), SOL_SOCKET, SO_PEERCRED, &user, &size) != 0) return "ipc";
  return fmt::format("ipc user {}", user.uid);
}

void set_options(tcp::socket& socket) {
  error_code ignored;
  socket.set_option(tcp::no_delay(true), ignored);
}
void set_options(Local::socket&) {}

class Connection;

/// State that all connections of a hub share.
struct Shared : net::Connections<Connection> {
  const CurveKeys* keys;
  Hub::Handler* handler = nullptr;
};

class Connection : public std::enable_shared_from_this<Connection> {
 public:
  using Socket = asio::generic::stream_protocol::socket;
  Connection(Shared& shared, Socket socket, Client client)
      : shared_(shared),
        socket_(std::move(socket)),
        client_(std::move(client)),
        group_(net::group_of(client_.peer)),
        session_(shared.limits.message, shared.keys) {}

  void start() {
    send(session_.take_output());
    read();
  }
  void answer(std::string_view response, const Envelope& envelope) {
    guard([&] {
      if (out_.size() < kMaxAnswers && n_unread_ < 2 * kMaxUnread) send(session_.pack(response, envelope));
    });
  }
  void drop(const char* why, const std::string& detail) {
    if (is_closed_) return;
    const auto self = shared_from_this();
    close();
    shared_.handler->dropped(client_, why, detail);
  }
  void close() {
    if (std::exchange(is_closed_, true)) return;
    error_code ignored;
    socket_.shutdown(Socket::shutdown_both, ignored);
    socket_.close(ignored);
    shared_.has_freed = shared_.has_freed || n_unread_ > 0 || n_held_ > 0;
    hold(0);
    if (out_.size() > 1) out_.erase(out_.begin() + 1, out_.end());  // the first one belongs to the write until it ends
    shared_.connections.erase(client_.connection);
  }

  /// Called once per second of this process's own time: if the machine was suspended, clients keep their connections.
  void sweep() {
    ++age_;
    ++silent_;
    slow_ = session_.is_receiving() ? slow_ + 1 : 0;
    if (!session_.is_open() && age_ > kHandshakePatience) return drop("handshake", "none within 10 s");
    if (silent_ > kSilencePatience) return drop("silent", "no byte for 15 s");
    // A peer's heartbeats wait behind its request. While the request arrives, pings show the peer that the server is
    // alive.
    if (session_.is_open() && out_.empty() && (slow_ > 1 || silent_ > kPingAfter)) send(session_.ping());
  }

  Standing standing() const {
    const bool has_key = session_.is_open() && !session_.client_key().empty();
    return {client_.connection, has_key ? session_.client_key() : group_, session_.is_open(), served_, began_, n_held_};
  }
  bool has_answers() const { return !out_.empty(); }

 private:
  /// If memory runs out, only this connection ends.
  template <class Step>
  void guard(Step step) {
    try {
      if (!is_closed_) step();
    } catch (const std::exception& exception) {
      drop("memory", exception.what());
    }
  }

  void read() {
    const std::span<std::byte> room = session_.room();
    socket_.async_read_some(asio::buffer(room.data(), room.size()),
                            [self = shared_from_this()](error_code error, std::size_t n) {
                              if (error) return self->close();
                              self->silent_ = 0;
                              if (!self->session_.is_receiving()) self->began_ = self->shared_.loop.now();
                              self->session_.filled(n);
                              self->handle();
                            });
  }

  /// Handles a few received messages. The rest follow after other connections had a turn, or once the peer has read its
  /// answers.
  void handle() {
    guard([this] {
      for (int i = 0; i < kTurn; ++i) {
        is_paused_ = out_.size() >= kMaxAnswers || n_unread_ >= kMaxUnread;
        if (is_paused_) return;
        Result<std::optional<Message>> message = session_.next();
        if (std::string control = session_.take_output(); !control.empty()) send(std::move(control));
        if (!message)
          return drop(message.error().where.c_str(),
                      fmt::format("expected {}, found {}", message.error().expected, message.error().found));
        hold(session_.n_held());
        if (!*message) {
          shared_.evict_slow_uploads();
          if (!is_closed_) read();
          return;
        }
        began_ = served_ = shared_.loop.now();
        if (!session_.client_key().empty()) client_.peer = session_.client_key();
        shared_.handler->received(client_, std::move(**message));
        if (is_closed_) return;
      }
      asio::post(shared_.loop.context(), [self = shared_from_this()] { self->handle(); });
    });
  }

  void hold(std::size_t n) {
    shared_.n_held += n - n_held_;
    n_held_ = n;
  }

  void send(std::string bytes) {
    n_unread_ += bytes.size();
    out_.push_back(std::move(bytes));
    if (out_.size() == 1) write();
  }
  void write() {
    asio::async_write(socket_, asio::buffer(out_.front()), [self = shared_from_this()](error_code error, std::size_t) {
      if (error) return self->close();
      self->n_unread_ -= self->out_.front().size();
      self->out_.pop_front();
      self->guard([&] {
        if (!self->out_.empty()) self->write();
        if (self->is_paused_ && self->out_.size() < kMaxAnswers / 2 && self->n_unread_ < kMaxUnread) self->handle();
      });
    });
  }

  Shared& shared_;
  Socket socket_;
  Client client_;
  const std::string group_;  // group of the peer's address
  Session session_;
  std::deque<std::string> out_;  // the first one is being written
  Clock::time_point began_ = client_.since, served_ = {};
  int age_ = 0, silent_ = 0, slow_ = 0;  // sweeps since: the connection came, a byte came, a request began
  std::size_t n_held_ = 0, n_unread_ = 0;
  bool is_paused_ = false, is_closed_ = false;
};

}  // namespace

class Hub::Sockets : public Shared {
 public:
  Sockets(net::Loop& its_loop, const Limits& its_limits, const CurveKeys* its_keys)
      : Shared{{its_loop, its_limits}, its_keys} {}
  ~Sockets() {
    for (const std::string& path : paths_) ::unlink(path.c_str());
    close_all();
  }

  Result<std::string> bind(const std::string& endpoint) {
    try {
      if (endpoint.starts_with("ipc://")) {
        std::string path = endpoint.substr(6);
        if (path.front() == '@') {
          path.front() = '\0';  // an abstract address has no file
        } else {
          ::unlink(path.c_str());  // check_free found no process that serves it
          paths_.push_back(path);
        }
        locals_.emplace_back(loop.context(), Local::endpoint(path));
        return endpoint;
      }
      const auto wanted = tcp_endpoint(endpoint.substr(6));
      if (!wanted) return cannot_bind(endpoint, error_code(ENODEV, boost::system::system_category()));
      tcps_.emplace_back(loop.context(), *wanted);
      return text_of(tcps_.back().endpoint());
    } catch (const boost::system::system_error& error) {
      return cannot_bind(endpoint, error.code());
    }
  }

  void begin(Handler& its_handler) {
    handler = &its_handler;
    for (auto& listener : tcps_) listener.listen([this](tcp::socket socket) { add(std::move(socket)); });
    for (auto& listener : locals_) listener.listen([this](Local::socket socket) { add(std::move(socket)); });
    sweeper_.turn([this] { sweep_all(); });
  }

  void send(std::uint64_t connection, std::string_view response, const Envelope& envelope) {
    answer(connection, [&](Connection& to) { to.answer(response, envelope); });
  }

 private:
  template <class Socket>
  void add(Socket socket) {
    set_options(socket);
    Client client{++n_connection_, peer_of(socket), {}, loop.now()};
    const auto connection = std::make_shared<Connection>(*this, std::move(socket), std::move(client));
    connections.emplace(n_connection_, connection);
    connection->start();
    evict_idle();
  }

  std::list<net::Listener<tcp>> tcps_;
  std::list<net::Listener<Local>> locals_;
  std::vector<std::string> paths_;
  net::Sweeper sweeper_{loop};
  std::uint64_t n_connection_ = 0;
};

Hub::Hub(net::Loop& loop, const Limits& limits, const CurveKeys* keys)
    : sockets_(std::make_unique<Sockets>(loop, limits, keys)) {}
Hub::~Hub() = default;
Result<std::string> Hub::bind(const std::string& endpoint) { return sockets_->bind(endpoint); }
void Hub::begin(Handler& handler) { sockets_->begin(handler); }
void Hub::send(std::uint64_t connection, std::string_view response, const Envelope& envelope) {
  sockets_->send(connection, response, envelope);
}
bool Hub::has_answers() const { return sockets_->has_answers(); }

}  // namespace vla::zmtp
