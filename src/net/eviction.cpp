// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "net/eviction.h"

#include <algorithm>
#include <boost/asio/ip/address.hpp>
#include <map>
#include <set>
#include <tuple>

namespace vla::net {
namespace {

namespace ip = boost::asio::ip;

constexpr auto kRecently = std::chrono::minutes(1);

/// The connections with a kept place: the oldest ones, so that a newcomer cannot take a place by asking more often.
std::set<std::uint64_t> kept(const Standings& standings, std::size_t max_connections, Clock::time_point now) {
  std::set<std::uint64_t> kept;
  for (const Standing& s : standings)
    if (kept.size() < max_connections / 2 && s.is_open && s.served > now - kRecently) kept.insert(s.connection);
  return kept;
}

template <class Amount>
std::map<std::string, std::size_t> sums_by_group(const Standings& standings, Amount amount) {
  std::map<std::string, std::size_t> sums;
  for (const Standing& s : standings) sums[s.group] += amount(s);
  return sums;
}

/// The candidate that is first by `rank`; among equals the oldest.
template <class Candidate, class Rank>
std::optional<std::uint64_t> first_of(const Standings& standings, Candidate is_candidate, Rank rank) {
  const Standing* first = nullptr;
  for (const Standing& s : standings)
    if (is_candidate(s) && (first == nullptr || rank(s) < rank(*first))) first = &s;
  return first == nullptr ? std::nullopt : std::optional(first->connection);
}

}  // namespace

std::string group_of(const std::string& peer) {
  boost::system::error_code not_an_address;
  const ip::address address = ip::make_address(peer, not_an_address);
  if (not_an_address) return peer;
  if (address.is_v6() && address.to_v6().is_v4_mapped())
    return group_of(ip::make_address_v4(ip::v4_mapped, address.to_v6()).to_string());
  if (address.is_v4()) return peer;
  ip::address_v6::bytes_type bytes = address.to_v6().to_bytes();
  std::fill(bytes.begin() + 8, bytes.end(), std::uint8_t{0});
  return ip::address_v6(bytes, address.to_v6().scope_id()).to_string() + "/64";
}

std::size_t max_handshakes(std::size_t max_connections) { return std::max<std::size_t>(1, max_connections / 4); }

std::optional<std::uint64_t> to_evict(const Standings& standings, std::size_t max_connections, Clock::time_point now) {
  const auto unfinished = [](const Standing& s) { return !s.is_open; };
  const auto n_unfinished = static_cast<std::size_t>(std::count_if(standings.begin(), standings.end(), unfinished));
  const bool is_full = standings.size() > max_connections;
  if (!is_full && n_unfinished <= max_handshakes(max_connections)) return std::nullopt;
  // Counts only connections that may give way: a robot's second connection must not lose its place because of the
  // first.
  const auto largest_of = [&](auto is_candidate) {
    const auto sums = sums_by_group(standings, [&](const Standing& s) { return std::size_t{is_candidate(s)}; });
    return first_of(standings, is_candidate, [&](const Standing& s) {
      const std::size_t sum = std::max(sums.at(s.group), max_connections / 16);
      return std::tuple(-static_cast<std::ptrdiff_t>(sum), s.n_held > 0, s.served);
    });
  };
  if (!is_full || n_unfinished > std::max<std::size_t>(1, max_connections / 8)) return largest_of(unfinished);
  const std::set<std::uint64_t> safe = kept(standings, max_connections, now);
  const auto found = largest_of([&](const Standing& s) { return s.is_open && !safe.contains(s.connection); });
  return found ? found : largest_of([](const Standing&) { return true; });
}

std::optional<std::uint64_t> to_interrupt(const Standings& standings, std::size_t max_connections,
                                          std::size_t max_message, std::size_t max_bytes, Clock::time_point now) {
  const auto sums = sums_by_group(standings, [](const Standing& s) { return s.n_held; });
  std::size_t total = 0;
  for (const auto& [group, sum] : sums) total += sum;
  if (total <= max_bytes) return std::nullopt;
  const std::set<std::uint64_t> safe = kept(standings, max_connections, now);
  return first_of(
      standings, [](const Standing& s) { return s.n_held > 0; },
      [&](const Standing& s) {
        const std::size_t sum = std::max(sums.at(s.group), max_message);
        return std::tuple(safe.contains(s.connection), -static_cast<std::ptrdiff_t>(sum), s.began);
      });
}

}  // namespace vla::net
