// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <boost/asio/io_context.hpp>
#include <boost/asio/steady_timer.hpp>
#include <chrono>
#include <functional>

namespace vla::net {

/// Accepts connections at one address. If no descriptor is left, it tries again a moment later.
template <class Protocol>
class Listener {
 public:
  using Socket = typename Protocol::socket;
  /// Binds at once. Errors: boost::system::system_error.
  Listener(boost::asio::io_context& context, const typename Protocol::endpoint& endpoint)
      : acceptor_(context, endpoint), retry_(context) {}

  /// Takes the descriptor of a socket that listens already.
  Listener(boost::asio::io_context& context, const Protocol& protocol, int descriptor)
      : acceptor_(context, protocol, descriptor), retry_(context) {}

  typename Protocol::endpoint endpoint() const { return acceptor_.local_endpoint(); }
  int descriptor() { return acceptor_.native_handle(); }

  /// Calls `taken` with each new connection from now on. Call it again after an exception.
  void listen(std::function<void(Socket)> taken) {
    if (!taken_) taken_ = std::move(taken);
    if (!is_waiting_ && !is_stopped_) accept();
  }

  /// Stops accepting connections. Destroy the listener only after the loop's last `wait`: the loop may still call its
  /// pending callbacks.
  void stop() {
    is_stopped_ = true;
    boost::system::error_code ignored;
    acceptor_.close(ignored);
    retry_.cancel();
  }

 private:
  void accept() {
    acceptor_.async_accept([this](boost::system::error_code error, Socket socket) {
      is_waiting_ = false;
      if (is_stopped_) return;
      if (error) return accept_later();
      taken_(std::move(socket));
      accept();
    });
    is_waiting_ = true;
  }
  void accept_later() {
    retry_.expires_after(std::chrono::milliseconds(100));
    retry_.async_wait([this](boost::system::error_code) {
      is_waiting_ = false;
      if (!is_stopped_) accept();
    });
    is_waiting_ = true;
  }

  typename Protocol::acceptor acceptor_;
  boost::asio::steady_timer retry_;
  std::function<void(Socket)> taken_;
  bool is_waiting_ = false, is_stopped_ = false;
};

}  // namespace vla::net
