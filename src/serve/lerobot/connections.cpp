// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/lerobot/connections.h"

#include <fmt/format.h>
#include <sys/socket.h>
#include <unistd.h>

#include <boost/asio/ip/tcp.hpp>
#include <boost/asio/post.hpp>
#include <charconv>
#include <map>
#include <mutex>

#include "net/listener.h"
#include "net/tcp.h"

namespace vla::serve::lerobot {
namespace {

namespace asio = boost::asio;
using asio::ip::tcp;
using boost::system::error_code;

/// An IPv4 address that came to a socket of IPv6 is one of IPv4.
tcp::endpoint plain(const tcp::endpoint& endpoint) {
  const asio::ip::address address = endpoint.address();
  if (!address.is_v6() || !address.to_v6().is_v4_mapped()) return endpoint;
  return {asio::ip::make_address_v4(asio::ip::v4_mapped, address.to_v6()), endpoint.port()};
}

/// ipv4:127.0.0.1:40000, ipv6:[::1]:40000, or with the brackets as %5B and %5D.
std::optional<tcp::endpoint> endpoint_of(std::string_view peer) {
  const std::size_t kind = peer.find(':'), colon = peer.rfind(':');
  if (kind == std::string_view::npos || colon <= kind) return std::nullopt;
  std::string host(peer.substr(kind + 1, colon - kind - 1));
  for (const std::string_view bracket : {"[", "]", "%5B", "%5D"})
    if (const std::size_t at = host.find(bracket); at != std::string::npos) host.erase(at, bracket.size());
  error_code not_an_address;
  const auto address = asio::ip::make_address(host, not_an_address);
  std::uint16_t port = 0;
  const auto read = std::from_chars(peer.data() + colon + 1, peer.data() + peer.size(), port);
  if (not_an_address || read.ec != std::errc()) return std::nullopt;
  return plain({address, port});
}

}  // namespace

/// Calls of gRPC's threads and handlers of the loop's meet at the lock.
class Connections::All {
 public:
  All(net::Loop& loop, const net::ConnectionLimits& limits) : loop_(loop), table_{loop, limits} {}
  ~All() {
    for (const auto& [number, connection] : table_.connections) connection->shut();
  }

  Result<std::string> bind(const std::string& address, const char* option, bool insecure) {
    return net::bind_tcp(listener_, loop_.context(), address, option, insecure);
  }
  void begin(Handler& handler) {
    handler_ = &handler;
    listener_->listen([this](tcp::socket socket) { add(std::move(socket)); });
  }

  std::optional<Peer> call_begins(const std::string& peer, std::size_t n_byte) {
    const auto endpoint = endpoint_of(peer);
    const std::lock_guard lock(mutex_);
    const auto number = endpoint ? numbers_.find(*endpoint) : numbers_.end();
    const auto found = number == numbers_.end() ? nullptr : table_.find(number->second);
    if (!found) return std::nullopt;
    if (found->n_held == 0) found->began = loop_.now();
    found->is_open = true;
    ++found->n_call;
    found->n_held += n_byte, table_.n_held += n_byte;
    ++n_call_;
    bound_calls();
    table_.evict_slow_uploads();
    return table_.find(found->peer.connection) ? std::optional(found->peer) : std::nullopt;
  }
  void receives(std::uint64_t connection, std::size_t n_byte) {
    const std::lock_guard lock(mutex_);
    const auto found = table_.find(connection);
    if (!found) return;
    found->n_held += n_byte, table_.n_held += n_byte;
    table_.evict_slow_uploads();
  }
  void received(std::uint64_t connection, std::size_t n_byte, bool is_whole) {
    const std::lock_guard lock(mutex_);
    const auto found = table_.find(connection);
    if (!found) return;
    found->n_held -= n_byte, table_.n_held -= n_byte;
    if (is_whole) found->served = loop_.now();
  }
  void call_ends(std::uint64_t connection) {
    const std::lock_guard lock(mutex_);
    if (const auto found = table_.find(connection)) --found->n_call, --n_call_;
  }

 private:
  struct Connection {
    All& all;
    const Peer peer;
    const tcp::endpoint endpoint;
    tcp::socket socket;
    const std::string group = net::group_of(peer.address);
    std::size_t n_call = 0, n_held = 0;  // n_held: bytes of calls that are not whole
    bool is_open = false;                // a call came
    Clock::time_point served = {}, began = {};

    net::Standing standing() const { return {peer.connection, group, is_open, served, began, n_held}; }
    /// gRPC sees that it ends, and ends its calls.
    void shut() { ::shutdown(socket.native_handle(), SHUT_RDWR); }
    void drop(const char* why, const std::string& detail) { all.take_out(*this, why, detail); }
  };

  /// One whose peer is gone already is not served.
  void add(tcp::socket socket) {
    error_code gone;
    socket.set_option(tcp::no_delay(true), gone);
    socket.native_non_blocking(true, gone);
    const tcp::endpoint endpoint = plain(socket.remote_endpoint(gone));
    const int descriptor = gone ? -1 : ::dup(socket.native_handle());
    if (descriptor < 0) return;
    const Peer peer{++n_connection_, endpoint.address().to_string(), loop_.now()};
    const std::shared_ptr<Connection> connection(new Connection{*this, peer, endpoint, std::move(socket)});
    {
      const std::lock_guard lock(mutex_);
      numbers_[endpoint] = peer.connection;
      table_.connections.emplace(peer.connection, connection);
    }
    // Until both directions are shut, by gRPC when it closes its descriptor or here. Keeps it alive until then.
    connection->socket.async_wait(tcp::socket::wait_error, [this, connection](error_code) { forget(*connection); });
    handler_->came(descriptor);
    const std::lock_guard lock(mutex_);
    table_.evict_idle();
  }
  void forget(Connection& connection) {
    const std::lock_guard lock(mutex_);
    const auto name = numbers_.find(connection.endpoint);
    if (name != numbers_.end() && name->second == connection.peer.connection) numbers_.erase(name);
    if (table_.find(connection.peer.connection)) take_out(connection, "", "");
  }
  void take_out(Connection& connection, const std::string& why, const std::string& detail) {
    asio::post(loop_.context(), [this, peer = connection.peer, why, detail] { handler_->ended(peer, why, detail); });
    n_call_ -= connection.n_call, table_.n_held -= connection.n_held;
    connection.shut();
    table_.connections.erase(connection.peer.connection);
  }
  /// Drops connections while there are too many calls: of the group that has most, the one whose calls began first. All
  /// groups are alike that have no more calls than one connection may.
  void bound_calls() {
    const std::size_t most = table_.limits.connections;
    while (n_call_ > most) {
      net::Standings all = table_.standings();
      for (net::Standing& standing : all) standing.n_held = table_.connections.at(standing.connection)->n_call;
      const auto chosen = net::to_interrupt(all, most, kMaxCalls, most, loop_.now());
      if (!chosen) return;
      table_.connections.at(*chosen)->drop("calls", fmt::format("more than {} at once, and these give way", most));
    }
  }

  net::Loop& loop_;
  std::optional<net::Listener<tcp>> listener_;
  Handler* handler_ = nullptr;
  std::uint64_t n_connection_ = 0;
  std::mutex mutex_;  // of what follows
  net::Connections<Connection> table_;
  std::map<tcp::endpoint, std::uint64_t> numbers_;  // of connections by what gRPC calls them
  std::size_t n_call_ = 0;
};

Connections::Connections(net::Loop& loop, const net::ConnectionLimits& limits)
    : all_(std::make_unique<All>(loop, limits)) {}
Connections::~Connections() = default;
Result<std::string> Connections::bind(const std::string& address, const char* option, bool insecure) {
  return all_->bind(address, option, insecure);
}
void Connections::begin(Handler& handler) { all_->begin(handler); }
std::optional<Peer> Connections::call_begins(const std::string& peer, std::size_t n_byte) {
  return all_->call_begins(peer, n_byte);
}
void Connections::receives(std::uint64_t connection, std::size_t n_byte) { all_->receives(connection, n_byte); }
void Connections::received(std::uint64_t connection, std::size_t n_byte, bool is_whole) {
  all_->received(connection, n_byte, is_whole);
}
void Connections::call_ends(std::uint64_t connection) { all_->call_ends(connection); }

}  // namespace vla::serve::lerobot
