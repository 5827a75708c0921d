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

/// Remembers the setups of an address, for a robot that reconnects and does not send its setup again. It inherits one
/// only if all robots of its address had the same setup and a connection with it has ended: with two kinds of robots
/// behind one address, one could get the other's joints.
class Setups {
 public:
  using Shared = std::shared_ptr<const Setup>;
  /// `most`: addresses to remember; a new one replaces one chosen by to_evict.
  explicit Setups(std::size_t most) : most_(most) {}

  /// A connection of the address now has this setup. Returns whether that changes what is known of the address.
  bool had(const std::string& address, const Shared& setup, Clock::time_point now);
  /// A connection with a setup has ended. Returns whether that changes what is known of the address.
  bool ended(const std::string& address, Clock::time_point now);
  /// The setup for a connection without one; null if there is none or several.
  Shared for_return(const std::string& address) const;
  /// Whether robots of the address have had several setups.
  bool is_ambiguous(const std::string& address) const;

  /// Encodes what is known of an address; empty if it was forgotten.
  std::string bytes_of(const std::string& address) const;
  void restore(const std::string& address, std::string_view bytes, const Names& names, Clock::time_point now);
  /// Returns the addresses that were forgotten since the last call.
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
