// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "door/floods.h"

#include <algorithm>

namespace vla::door {
namespace {

constexpr std::uint8_t kEndStream = 0x1;

}  // namespace

const char* Floods::count(std::span<const std::byte> bytes, Clock::time_point now) {
  for (;;) {
    const auto skipped = static_cast<std::size_t>(std::min<std::uint64_t>(to_skip_, bytes.size()));
    bytes = bytes.subspan(skipped);
    to_skip_ -= skipped;
    if (bytes.empty()) return nullptr;
    head_[n_head_++] = static_cast<std::uint8_t>(bytes[0]);
    bytes = bytes.subspan(1);
    if (n_head_ < head_.size()) continue;
    n_head_ = 0;
    if (const char* too_much = count_frame(now)) return too_much;
  }
}

const char* Floods::count_frame(Clock::time_point now) {
  const std::uint32_t length = std::uint32_t{head_[0]} << 16 | std::uint32_t{head_[1]} << 8 | head_[2];
  const std::uint8_t type = head_[3], flags = head_[4];
  to_skip_ = length;
  if (type == kHeaders) header_block_ = 0;
  if (type == kHeaders || type == kContinuation) {
    header_block_ += length;
    if (header_block_ > kMaxHeaderBlock) return "bytes of headers";
  }
  if (type == kData && (flags & kEndStream) == 0 && length < kTinyData) return spend(length == 0 ? kEmpty : kTiny, now);
  return spend(type > kContinuation ? kOther : type, now);
}

const char* Floods::spend(std::size_t kind, Clock::time_point now) {
  Allowance& allowance = allowances_[kind];
  const Kind& allowed = kAllowed[kind];
  const double seconds = std::chrono::duration<double>(now - allowance.at).count();
  allowance.left =
      allowance.left < 0 ? allowed.burst : std::min(allowed.burst, allowance.left + seconds * allowed.per_second);
  allowance.at = now;
  if (allowance.left < 1) return allowed.told;
  allowance.left -= 1;
  return nullptr;
}

}  // namespace vla::door
