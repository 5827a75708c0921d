// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <fmt/format.h>

#include <algorithm>
#include <map>
#include <memory>

#include "net/eviction.h"
#include "net/loop.h"

namespace vla::net {

struct ConnectionLimits {
  std::size_t message = 0;      // bytes of a request
  std::size_t connections = 0;  // at once
  std::size_t receipt = 0;      // bytes of all requests that are not whole yet
};

/// The connections of a protocol, and what they may hold together. A Connection has `standing()`, `has_answers()` and
/// `drop(why, detail)`, which takes it out of the table.
template <class Connection>
struct Connections {
  Loop& loop;
  ConnectionLimits limits;
  std::map<std::uint64_t, std::shared_ptr<Connection>> connections = {};  // oldest first
  std::size_t n_held = 0;                                                 // bytes of requests that are not whole

  /// Null where it has ended. The pointer keeps it while something is done with it.
  std::shared_ptr<Connection> find(std::uint64_t connection) const {
    const auto found = connections.find(connection);
    return found == connections.end() ? nullptr : found->second;
  }
  /// Drops connections until no more are left than `limits.connections`.
  void evict_idle() {
    while (const auto chosen = to_evict(standings(), limits.connections, loop.now()))
      connections.at(*chosen)->drop("connections",
                                    fmt::format("more than {}, or {} in their handshake, and this one gives way",
                                                limits.connections, max_handshakes(limits.connections)));
  }
  /// Drops connections until requests in receipt hold no more than `limits.receipt`.
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
  /// Calls `sweep` of each, which may end it.
  void sweep_all() {
    const auto all = connections;
    for (const auto& [id, connection] : all) connection->sweep();
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
