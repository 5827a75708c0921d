// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "base/clock.h"

namespace vla::net {

/// The facts about a connection that decide whether it gives way.
struct Standing {
  std::uint64_t connection = 0;   // rises with every new connection
  std::string group;              // `group_of` the peer
  bool is_open = false;           // its handshake is complete; with keys it is authenticated
  Clock::time_point served = {};  // time of its last request
  Clock::time_point began = {};   // start of the request that it is sending
  std::size_t n_held = 0;         // bytes of that request so far
};
/// Oldest connection first.
using Standings = std::vector<Standing>;

/// The group that counts as one peer: the first 64 bits of an IPv6 address; any other text, such as an IPv4 address or
/// a key, is a group of its own. This holds for addresses of this machine too, so that a local program does not share
/// its robot's group.
std::string group_of(const std::string& peer);

/// The facts that decide whose turn it is in a queue.
struct Share {
  std::string group;             // `group_of` the peer
  Clock::time_point since = {};  // when the peer connected
};

/// How many connections may be in the handshake at once.
std::size_t max_handshakes(std::size_t max_connections);

/// Chooses the connection that gives way to new ones; none while places are free. Half of the places are kept for the
/// oldest connections that were served within the last minute. Handshakes give way first if they hold more than an
/// eighth of the places. Else the choice is a connection without a kept place, of the group with most such connections;
/// groups with at most a sixteenth of the places count as equal. Within a group, connections that are not sending a
/// request go first, and among them the least recently served.
std::optional<std::uint64_t> to_evict(const Standings& standings, std::size_t max_connections, Clock::time_point now);

/// Chooses the connection whose incomplete request gives way if incomplete requests hold more than `max_bytes`
/// together; none otherwise. Connections with a kept place are last. Then the group with most bytes is chosen, where
/// groups with at most one largest message count as equal, and in it the request that began first.
std::optional<std::uint64_t> to_interrupt(const Standings& standings, std::size_t max_connections,
                                          std::size_t max_message, std::size_t max_bytes, Clock::time_point now);

}  // namespace vla::net
