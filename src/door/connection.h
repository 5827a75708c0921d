// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <nghttp2/nghttp2.h>

#include <boost/asio/ip/tcp.hpp>
#include <deque>
#include <exception>
#include <list>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "door/floods.h"
#include "door/rpcs.h"

namespace vla::door {

constexpr std::size_t kMaxHeaderList = 16 << 10;  // decompressed header bytes per call

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

/// What all connections have in common.
struct Shared : net::Connections<Connection> {
  Rpcs::Handler* handler = nullptr;
  std::vector<std::uint8_t> in = std::vector<std::uint8_t>(256 << 10);  // receive buffer of the connection being read
  std::map<std::uint64_t, Call*> calls = {};                            // not answered yet
  std::uint64_t n_id = 0;
  std::size_t n_call = 0;
  bool is_stopping = false, is_handling = false;

  void bound_calls();
  void hand_over(Call& call, serve::lerobot::Rpc rpc);
  void handle_later();
  void handle_next();

  /// Complete calls are handled one after the other, in turn by group of peers.
  std::list<std::pair<std::string, std::deque<serve::lerobot::Rpc>>> turns = {};
};

/// A peer's HTTP/2 session. Running out of memory for it ends this connection only.
class Connection : public std::enable_shared_from_this<Connection> {
 public:
  using Socket = boost::asio::ip::tcp::socket;

  Connection(Shared& shared, Socket socket, serve::lerobot::Peer peer);
  ~Connection();

  void start(const nghttp2_session_callbacks* callbacks, const nghttp2_option* option);
  /// Closes the connection and tells the handler why.
  void drop(const char* why, const std::string& detail) { close(why, detail); }
  void close(const char* why = "", const std::string& detail = {});
  /// Once a second: ends a connection that is silent or stalled, and refuses calls whose message is late.
  void sweep();
  net::Standing standing() const { return {peer_.connection, group_, is_open_, served_, began_, n_held_}; }
  std::size_t n_call() const { return calls_.size(); }
  bool has_answers() const;
  const std::string& group() const { return group_; }

  void answer(Call& call, const std::string& message);
  void refuse(Call& call, const Error& error);
  /// Releases a call's message from `n_held`: the handler takes it.
  void received(Call& call);

  // Callbacks for the library. No exception may pass through it.
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
  void sent_last(std::int32_t stream);
  void closed(std::int32_t stream);

 private:
  template <class Step>
  void guard(Step step) noexcept {
    const auto self = shared_from_this();
    try {
      if (!is_closed_) step();
    } catch (const std::exception& exception) {
      try {
        drop("memory", exception.what());
      } catch (const std::exception&) {  // the connection is closed; the handler may not know
      }
    }
  }

  void read();
  void receive();
  void flush();

  Call* find(std::int32_t stream);
  void hold(Call& call, std::ptrdiff_t n);
  void take_frames(Call& call);
  Status take_message(Call& call, std::string_view message);
  void hand_over(Call& call);

  static ssize_t read_answer(nghttp2_session* session, std::int32_t stream, std::uint8_t* to, std::size_t size,
                             std::uint32_t* flags, nghttp2_data_source* source, void*);
  /// Removes a call from those that wait for an answer. Returns false if it is answered already.
  bool take(Call& call);
  void end(Call& call);
  void refuse_late();

  const serve::lerobot::Peer peer_;
  const std::string group_;
  Shared& shared_;
  Socket socket_;
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

}  // namespace vla::door
