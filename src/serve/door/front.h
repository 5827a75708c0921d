// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <boost/asio/steady_timer.hpp>
#include <map>
#include <optional>

#include "net/loop.h"
#include "net/tcp.h"
#include "serve/door/link.h"
#include "serve/door/process.h"
#include "serve/front.h"
#include "serve/names.h"
#include "serve/options.h"

namespace vla::serve {

/// A protocol that runs in a process of its own, because it links a large library or parses much untrusted data. The
/// process holds the connections and sends native requests to this server. The server binds the address, so that
/// clients can wait while the process is restarted, and keeps the data that the process wants back after a restart.
class DoorFront final : public Front, Link::Handler {
 public:
  struct Door {
    const char *program, *option, *name, *scheme;  // vla-door-x, --x, x, x://
    std::string ServerOptions::*address;
    /// The names that its clients use. Errors: usage if the protocol cannot carry the policy's inputs.
    Result<Names> (*names_of)(const ServerOptions& options, const v1::Description& description);
  };
  /// Binds the address and starts the process. Errors: usage, io, unsupported.
  static Result<std::unique_ptr<Front>> open(net::Loop& loop, const ServerOptions& options, const Door& door);

  std::vector<std::string> addresses() const override { return {door_.scheme + address_}; }
  Status serve(const ServedPolicy& policy) override;
  std::string told() const override { return told_; }
  void begin(Io& io) override;
  bool has_answers() const override { return link_ && link_->n_queued() > 0; }
  ~DoorFront() override;

 private:
  class Request;
  struct Client {
    std::string address;
    Clock::time_point since;
    std::uint64_t n_request = 0;
  };

  DoorFront(net::Loop& loop, const ServerOptions& options, const Door& door);
  Status start();
  Status await_ready();
  void start_again();
  void beat();
  void fail(const std::string& why);
  void retry(const std::string& why);
  void came(LinkMessage message) override;
  void broke(const std::string& why) override { fail(why); }
  void opened(const LinkMessage& message);
  void closed(const LinkMessage& message);
  void submit(LinkMessage message);
  void submit(Client& client, LinkMessage message, const wire::Envelope& envelope, const Status& valid);
  void keep(const LinkMessage& message);
  void respond(std::uint64_t generation, std::uint64_t connection, const std::string& response);
  std::string name_of(std::uint64_t connection) const;

  net::Loop& loop_;
  const ServerOptions options_;
  const Door& door_;
  std::optional<net::Listener<boost::asio::ip::tcp>> listener_;  // bound here; the process accepts from it
  std::string address_, told_, description_;
  Process process_;
  std::optional<Link> link_;
  boost::asio::steady_timer timer_;
  bool is_begun_ = false;
  int n_silent_ = 0, n_failure_ = 0;  // unanswered heartbeats; failures in a row
  Clock::time_point started_ = {};
  // generation_: number of process starts; first_: highest connection number before the current process; last_: highest
  // connection number so far
  std::uint64_t generation_ = 0, first_ = 0, last_ = 0;
  std::map<std::uint64_t, Client> clients_;
  std::map<std::string, std::string> kept_;
  Io* io_ = nullptr;
};

}  // namespace vla::serve
