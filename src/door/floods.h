// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <span>

#include "base/clock.h"

namespace vla::door {

/// Counts the HTTP/2 frames that a peer sends, by their headers and before any library parses them. Each kind has an
/// allowance that refills over time: several times what a robot at 60 Hz uses. RFC 9113, sections 4 and 6.
class Floods {
 public:
  static constexpr std::uint32_t kMaxHeaderBlock = 16 << 10;  // bytes of HEADERS and CONTINUATION frames

  /// Counts the bytes that arrived. Returns what exceeds its allowance, in words, or null.
  const char* count(std::span<const std::byte> bytes, Clock::time_point now);

 private:
  enum Type : std::uint8_t {
    kData,
    kHeaders,
    kPriority,
    kReset,
    kSettings,
    kPush,
    kPing,
    kGoaway,
    kWindow,
    kContinuation
  };
  struct Kind {
    const char* told;
    double burst, per_second;
  };
  static constexpr std::size_t kTiny = 10, kEmpty = 11, kOther = 12, kKinds = 13;
  static constexpr std::uint32_t kTinyData = 256;
  static constexpr std::array<Kind, kKinds> kAllowed{{{"DATA", 1e9, 1e9},
                                                      {"HEADERS", 1000, 500},
                                                      {"PRIORITY", 100, 10},
                                                      {"RST_STREAM", 100, 20},
                                                      {"SETTINGS", 100, 10},
                                                      {"PUSH_PROMISE", 0, 0},
                                                      {"PING", 200, 50},
                                                      {"GOAWAY", 10, 1},
                                                      {"WINDOW_UPDATE", 2000, 1000},
                                                      {"CONTINUATION", 64, 16},
                                                      {"DATA with little in them", 2000, 1000},
                                                      {"DATA with nothing in them", 200, 50},
                                                      {"frames of other types", 100, 10}}};
  struct Allowance {
    double left = -1;  // full at the start
    Clock::time_point at = {};
  };

  const char* count_frame(Clock::time_point now);
  const char* spend(std::size_t kind, Clock::time_point now);

  std::uint64_t to_skip_ = 24;  // the client's preface first, then payloads
  std::array<std::uint8_t, 9> head_ = {};
  std::size_t n_head_ = 0;
  std::uint32_t header_block_ = 0;
  std::array<Allowance, kKinds> allowances_;
};

}  // namespace vla::door
