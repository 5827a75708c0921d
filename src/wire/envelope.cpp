// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "wire/envelope.h"

#include <fmt/format.h>

#include <algorithm>

#include "wire/fields.h"
#include "wire/vla.pb.h"

namespace vla::wire {
namespace {

constexpr std::size_t kMaxName = 256;  // bytes

Kind kind_of(int number) {
  switch (number) {
    case v1::Request::kHelloFieldNumber:
      return Kind::hello;
    case v1::Request::kDescribeFieldNumber:
      return Kind::describe;
    case v1::Request::kActFieldNumber:
      return Kind::act;
    case v1::Request::kHealthFieldNumber:
      return Kind::health;
    default:
      return Kind::unknown;
  }
}

/// A request of another version may have fields that this version does not know. It is refused for its version, not for
/// the fields.
Status read_request(std::span<const std::byte> request, Envelope& envelope) {
  std::optional<Error> unknown;
  for (Fields field(request, "request");;) {
    VLA_TRY(const bool more, field.next());
    if (!more) break;
    if (field.number == v1::Request::kProtocolVersionFieldNumber && field.type == 'v') {
      envelope.version = static_cast<std::uint32_t>(std::min<std::uint64_t>(field.varint, ~std::uint32_t{0}));
    } else if (field.number == v1::Request::kRequestIdFieldNumber && field.type == 'v') {
      envelope.request_id = field.varint;
    } else if (kind_of(field.number) != Kind::unknown && field.type == 'b') {
      if (envelope.kind != Kind::unknown)
        return not_a_request("request", "one of hello, describe, act, health", "a second one");
      envelope.kind = kind_of(field.number);
      envelope.body_at = static_cast<std::size_t>(field.value.data() - request.data());
      envelope.body_size = field.value.size();
    } else {
      unknown = field.unknown();
    }
  }
  if (envelope.version < kMinVersion || envelope.version > kMaxVersion)
    return incompatible(envelope.version, envelope.version);
  return unknown ? Status(*unknown) : Status();
}

Status read_act(std::span<const std::byte> act, Envelope& envelope) {
  for (Fields field(act, "request.act");;) {
    VLA_TRY(const bool more, field.next());
    if (!more) return {};
    if (field.number == v1::Act::kDeadlineMsFieldNumber) {
      if (field.type != 'v') return field.unknown();
      envelope.deadline_ms = field.varint;
    } else if (field.number == v1::Act::kPolicyFieldNumber) {
      if (field.type != 'b') return field.unknown();
      if (field.value.size() > kMaxName)
        return Error{Code::too_large, "policy", fmt::format("names of at most {} bytes", kMaxName),
                     fmt::format("{} bytes", field.value.size())};
      envelope.policy.assign(reinterpret_cast<const char*>(field.value.data()), field.value.size());
    }
  }
}

}  // namespace

Error incompatible(std::uint32_t min, std::uint32_t max) {
  const auto range = [](std::uint32_t from, std::uint32_t to) {
    return from == to ? fmt::format("version {}", from) : fmt::format("versions {} to {}", from, to);
  };
  return {Code::incompatible, "request.protocol_version", range(kMinVersion, kMaxVersion), range(min, max),
          max < kMinVersion ? "update the client" : "update the server"};
}

Status read_envelope(std::span<const std::byte> request, Envelope& envelope) {
  VLA_CHECK(read_request(request, envelope));
  if (envelope.kind == Kind::unknown) return not_a_request("request", "one of hello, describe, act, health", "none");
  return envelope.kind == Kind::act ? read_act(envelope.body(request), envelope) : Status();
}

}  // namespace vla::wire
