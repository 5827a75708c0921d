// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <fmt/format.h>
#include <malloc.h>

#include <algorithm>
#include <map>
#include <memory>
#include <utility>

#include "net/eviction.h"
#include "net/loop.h"

namespace vla::net {

struct ConnectionLimits {
  std::size_t message = 0;      // bytes in one request
  std::size_t connections = 0;  // open at once
  std::size_t receipt = 0;      // bytes in all incomplete requests
};

/// The connections of a protocol and their common limits. A Connection has `standing()`, `has_answers()` and `drop(why,
/// detail)`, which removes it from the table.
template <class Connection>
struct Connections {
  Loop& loop;
  ConnectionLimits limits;
  std::map<std::uint64_t, std::shared_ptr<Connection>> connections = {};  // oldest first
  std::size_t n_held = 0;                                                 // bytes in incomplete requests
  bool has_freed = false;  // since the last sweep, ended connections freed requests or answers

  /// Returns a connection; null if it has ended. The pointer keeps it alive while it is used.
  std::shared_ptr<Connection> find(std::uint64_t connection) const {
    const auto found = connections.find(connection);
    return found == connections.end() ? nullptr : found->second;
  }
  /// Calls `send` with the connection. If it has ended, only notes that its request is freed.
  template <class Send>
  void answer(std::uint64_t connection, Send send) {
    if (const auto found = find(connection)) {
      send(*found);
    } else {
      has_freed = true;
    }
  }
  /// Drops connections until at most `limits.connections` are left.
  void evict_idle() {
    while (const auto chosen = to_evict(standings(), limits.connections, loop.now()))
      connections.at(*chosen)->drop("connections",
                                    fmt::format("more than {}, or {} in their handshake, and this one gives way",
                                                limits.connections, max_handshakes(limits.connections)));
  }
  /// Drops connections until incomplete requests hold at most `limits.receipt` bytes.
  void evict_slow_uploads() {
    while (n_held > limits.receipt) {
      const auto chosen = to_interrupt(standings(), limits.connections, limits.message, limits.receipt, loop.now());
      if (!chosen) return;
      connections.at(*chosen)->drop(
          "receipt",
          fmt::format("requests in receipt took more than {} bytes, and this one gives way", limits.receipt));
    }
  }
  bool has_answers() const {
    return std::any_of(connections.begin(), connections.end(), [](const auto& c) { return c.second->has_answers(); });
  }
  /// Calls `sweep` on each connection, which may end it. Returns memory that a flood took to the system.
  void sweep_all() {
    const auto all = connections;
    for (const auto& [id, connection] : all) connection->sweep();
    if (std::exchange(has_freed, false)) ::malloc_trim(0);
  }
  void close_all() {
    while (!connections.empty()) connections.begin()->second->close();
  }

  Standings standings() const {
    Standings all;
    all.reserve(connections.size());
    for (const auto& [id, connection] : connections) all.push_back(connection->standing());
    return all;
  }
};

}  // namespace vla::net
