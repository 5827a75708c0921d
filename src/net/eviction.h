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
  std::uint64_t connection = 0;   // rises in the order in which they came
  std::string group;              // `group_of` its peer
  bool is_open = false;           // its handshake is done: with keys, it is authenticated
  Clock::time_point served = {};  // its last request
  Clock::time_point began = {};   // the request that is being received
  std::size_t n_held = 0;         // bytes of that request
};
/// Oldest connection first.
using Standings = std::vector<Standing>;

/// The group that counts as one peer: an IPv6 address by its first 64 bits. Other text, such as an IPv4 address or a
/// key, is its own group, also of this machine: a program there must not share its robot's.
std::string group_of(const std::string& peer);

/// The facts that decide whose turn it is in a queue.
struct Share {
  std::string group;             // `group_of` the peer
  Clock::time_point since = {};  // its connection
};

/// How many connections may be in their handshake at once.
std::size_t max_handshakes(std::size_t max_connections);

/// The connection that gives way to new ones; none where there is room. Half of the places are kept for the oldest
/// connections that were served within a minute. Handshakes give way before open connections, except for an eighth of
/// the places; then the group that has most of those that could, where all that have a sixteenth of the places or less
/// are alike, and in it those that are not sending a request, the one that was served longest ago before others.
std::optional<std::uint64_t> to_evict(const Standings& standings, std::size_t max_connections, Clock::time_point now);

/// The connection whose half-received request gives way where all of them take more than `max_bytes`; none otherwise.
/// Connections with a kept place come last; then the group with most bytes, where all that hold no more than one
/// largest message are alike, and in it the request that began first.
std::optional<std::uint64_t> to_interrupt(const Standings& standings, std::size_t max_connections,
                                          std::size_t max_message, std::size_t max_bytes, Clock::time_point now);

}  // namespace vla::net
