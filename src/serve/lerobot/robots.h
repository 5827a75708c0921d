// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <deque>
#include <map>

#include "serve/lerobot/calls.h"
#include "serve/lerobot/setups.h"

namespace vla::serve::lerobot {

/// The robots that speak LeRobot's asynchronous inference, one per connection: their setups, their newest observations,
/// and the calls that wait for actions. Reads pickles without executing anything, and keeps only the act.
class Robots final : public CallHandler {
 public:
  /// The server that computes.
  class Server {
   public:
    virtual ~Server() = default;
    virtual void opened(const Peer& peer) = 0;
    virtual void closed(const Peer& peer, const std::string& why, const std::string& detail) = 0;
    /// Takes a serialized v1::Request; returns false if too many are still queued.
    virtual bool ask(std::uint64_t connection, const std::string& request) = 0;
    /// A call that was refused here.
    virtual void refused(std::uint64_t connection) = 0;
    /// Keeps data for `restore` after a restart of this process; empty: forget it.
    virtual void keep(const std::string& address, const std::string& bytes) = 0;
  };
  struct Limits {
    std::size_t observed = 0;   // bytes of all robots' observations that no call has requested yet
    std::size_t message = 0;    // bytes of one observation
    std::size_t addresses = 0;  // addresses whose setups are remembered
  };
  Robots(Now now, const Limits& limits, Calls& calls, Server& server)
      : now_(now), limits_(limits), calls_(calls), server_(server), setups_(limits.addresses) {}

  /// Sets the served policy; call it before any call is handled.
  void serve(Names names, const v1::Description& description);
  void restore(const std::string& address, std::string_view bytes) { setups_.restore(address, bytes, names_, now_()); }

  void called(Rpc rpc) override;
  void cancelled(std::uint64_t id) override;
  void opened(const Peer& peer) override { server_.opened(peer); }
  void closed(const Peer& peer, const std::string& why, const std::string& detail) override;
  /// Takes the server's answer, a serialized v1::Response, to a request of the connection.
  void answered(std::uint64_t connection, std::span<const std::byte> response);
  /// Call it once a second: a call that has waited too long for actions gets an empty answer.
  void sweep();
  /// Refuses the waiting calls.
  void stop();

 private:
  using Shared = Setups::Shared;
  struct Seen {
    Observed observed;
    v1::Request request;
    std::size_t size = 0;
  };
  struct Waiting {
    std::uint64_t rpc;
    Clock::time_point since;
  };
  struct Asked {
    std::uint64_t rpc;
    Observed observed;
    Shared setup;
  };
  struct Client {
    Peer peer;
    Shared setup;
    Filter filter;
    std::optional<Seen> seen;              // the newest observation to compute
    std::deque<Waiting> waiting;           // calls that wait for actions
    std::map<std::uint64_t, Asked> asked;  // keyed by request number
    std::uint64_t n_request = 0;
    Clock::time_point used = {};
  };

  Result<std::string> answer_now(Rpc& rpc, Client& client);
  Status observe(const Rpc& rpc, Client& client);
  Status check_setup(const Rpc& rpc, Client& client);
  void adopt(Client& client, Shared setup);
  void bound_seen();
  void ask(Client& client);
  Result<std::string> actions_of(const v1::Response& response, const Asked& asked) const;
  void keep(const std::string& address);

  const Now now_;
  const Limits limits_;
  Calls& calls_;
  Server& server_;
  Names names_;
  v1::Description description_;
  double period_ = 0;  // seconds between rows of a chunk
  std::map<std::uint64_t, Client> clients_;
  Setups setups_;
};

}  // namespace vla::serve::lerobot
