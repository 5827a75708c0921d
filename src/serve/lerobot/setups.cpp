// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/lerobot/setups.h"

#include <algorithm>

namespace vla::serve::lerobot {

Setups::Place& Setups::place_of(const std::string& address, Clock::time_point now) {
  Place& place = places_[address];
  if (place.number == 0) place.number = ++n_place_;
  place.used = now;
  net::Standings all;
  for (const auto& [key, other] : places_)
    all.push_back({other.number, net::group_of(key), true, other.used, other.used, 0});
  std::sort(all.begin(), all.end(), [](const auto& a, const auto& b) { return a.connection < b.connection; });
  const auto forgotten = net::to_evict(all, most_, now);
  const auto found =
      std::find_if(places_.begin(), places_.end(), [&](const auto& each) { return forgotten == each.second.number; });
  if (found == places_.end() || &found->second == &place) return place;
  forgotten_.push_back(found->first);
  places_.erase(found);
  return place;
}

bool Setups::had(const std::string& address, const Shared& setup, Clock::time_point now) {
  const bool is_new = !places_.contains(address);
  Place& place = place_of(address, now);
  if (!is_new && (place.setup == nullptr || is_same(*place.setup, *setup))) return false;
  place.setup = is_new ? setup : nullptr;
  return true;
}

bool Setups::ended(const std::string& address, Clock::time_point now) {
  const auto found = places_.find(address);
  if (found == places_.end()) return false;
  found->second.used = now;
  return !std::exchange(found->second.has_ended, true);
}

Setups::Shared Setups::for_return(const std::string& address) const {
  const auto found = places_.find(address);
  return found != places_.end() && found->second.has_ended ? found->second.setup : nullptr;
}

bool Setups::is_ambiguous(const std::string& address) const {
  const auto found = places_.find(address);
  return found != places_.end() && (found->second.setup == nullptr || !found->second.has_ended);
}

/// Format: `s` if there are several setups; else `o`, then the setup. `has_ended` is not stored: the process that reads
/// this has lost all connections.
std::string Setups::bytes_of(const std::string& address) const {
  const auto found = places_.find(address);
  if (found == places_.end()) return {};
  const Shared& setup = found->second.setup;
  return setup == nullptr ? "s" : "o" + lerobot::bytes_of(*setup);
}

void Setups::restore(const std::string& address, std::string_view bytes, const Names& names, Clock::time_point now) {
  if (bytes.empty()) return;
  Place& place = place_of(address, now);
  place.has_ended = true;
  place.setup = nullptr;
  if (bytes[0] != 'o') return;
  if (auto setup = setup_of(bytes.substr(1), names)) place.setup = std::make_shared<const Setup>(std::move(*setup));
}

}  // namespace vla::serve::lerobot
