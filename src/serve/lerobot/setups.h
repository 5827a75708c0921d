// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <memory>
#include <optional>
#include <string>

#include "net/eviction.h"
#include "serve/lerobot/codec.h"

namespace vla::serve::lerobot {

/// The set-ups that robots of an address had, for one of them that comes back on another connection and does not say
/// again what it is. It gets a set-up only where every robot of its address has had the same one and a connection with
/// it has ended: with two kinds of robots behind an address, one could get the joints of the other.
class Setups {
 public:
  using Shared = std::shared_ptr<const Setup>;
  /// `most`: addresses that are remembered; a new one takes the place of one by to_evict's rules.
  explicit Setups(std::size_t most) : most_(most) {}

  /// A connection of the address has this set-up now. Whether that is news about the address.
  bool had(const std::string& address, const Shared& setup, Clock::time_point now);
  /// A connection with a set-up has ended. Also news.
  bool ended(const std::string& address, Clock::time_point now);
  /// The set-up for a connection without one; null where there is none, or more than one.
  Shared for_return(const std::string& address) const;
  /// Whether robots of the address have had several.
  bool is_ambiguous(const std::string& address) const;

  /// What there is to be known about an address, as bytes; none where it is forgotten.
  std::string bytes_of(const std::string& address) const;
  void restore(const std::string& address, std::string_view bytes, const Names& names, Clock::time_point now);
  /// The addresses that were forgotten since the last call.
  std::vector<std::string> take_forgotten() { return std::exchange(forgotten_, {}); }

 private:
  struct Place {
    std::uint64_t number = 0;
    Shared setup;  // null: several
    bool has_ended = false;
    Clock::time_point used = {};
  };
  Place& place_of(const std::string& address, Clock::time_point now);

  const std::size_t most_;
  std::uint64_t n_place_ = 0;
  std::map<std::string, Place> places_;
  std::vector<std::string> forgotten_;
};

}  // namespace vla::serve::lerobot
