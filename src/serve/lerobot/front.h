// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <deque>
#include <map>

#include "base/clock.h"
#include "net/sweeper.h"
#include "serve/front.h"
#include "serve/lerobot/codec.h"
#include "serve/lerobot/rpcs.h"
#include "serve/options.h"

namespace vla::serve::lerobot {

/// The protocol of LeRobot's asynchronous inference: gRPC with pickles, which are read without executing anything
/// (docs/drop_in.md). Only in builds with libgrpc++.
class Front final : public serve::Front, Rpcs::Handler {
 public:
  /// Binds `options.lerobot`. Errors: usage, io.
  static Result<std::unique_ptr<serve::Front>> open(net::Loop& loop, const ServerOptions& options);

  std::vector<std::string> addresses() const override { return {"grpc://" + address_}; }
  Status serve(const ServedPolicy& policy) override;
  std::string told() const override { return "lerobot=" + names_.told(); }
  void begin(Io& io) override;
  bool has_answers() const override { return rpcs_.has_answers(); }

 private:
  class Request;
  /// A robot: one connection.
  struct Client {
    Peer peer;
    std::shared_ptr<const Setup> setup;
    Filter filter;
    std::shared_ptr<const Observed> observed;  // the newest that is to be computed
    struct Asking {
      std::uint64_t rpc;
      Clock::time_point since;
    };
    std::deque<Asking> asking;  // for actions
    std::uint64_t n_request = 0;
    Clock::time_point used = {};
  };

  Front(net::Loop& loop, const ServerOptions& options);
  void called(Rpc rpc) override;
  void cancelled(std::uint64_t rpc) override;
  void ended(const Peer& peer, const std::string& why, const std::string& detail) override;
  Result<std::string> answer_now(Rpc& rpc, Client& client);
  Client& client_of(const Peer& peer);
  void evict_idle();
  void bound_observed();
  void submit_next(Client& client);
  void sweep();

  const ServerOptions options_;
  const net::Loop& loop_;
  Rpcs rpcs_;
  net::Sweeper sweeper_;
  std::string address_;
  v1::Description description_;
  Names names_;
  double period_ = 0;                        // seconds between rows of a chunk
  std::map<std::uint64_t, Client> clients_;  // by their connections, also past ones
  Io* io_ = nullptr;
};

}  // namespace vla::serve::lerobot
