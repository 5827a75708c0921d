// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>

#include "base/result.h"

namespace vla::wire {

enum class Kind { unknown, hello, describe, act, health };

constexpr const char* kind_name(Kind kind) {
  constexpr const char* kNames[] = {"unknown", "hello", "describe", "act", "health"};
  return kNames[static_cast<int>(kind)];
}

/// The error class of a code on the wire; `internal` for an unknown number.
constexpr Code code_of(int number) {
  const bool is_known = number >= exit_code(Code::internal) && number <= exit_code(Code::shutting_down);
  return is_known ? static_cast<Code>(number - exit_code(Code::internal)) : Code::internal;
}

/// The protocol versions that this build speaks.
constexpr std::uint32_t kMinVersion = 1, kMaxVersion = 1;

/// The part of a request that the I/O thread needs to queue, answer or refuse it, without reading an image.
struct Envelope {
  std::uint32_t version = 0;
  std::uint64_t request_id = 0;
  Kind kind = Kind::unknown;
  std::size_t body_at = 0, body_size = 0;  // byte range of the serialized Hello, Describe, Act or Health in the request
  std::optional<std::uint64_t> deadline_ms;  // deadline of an act
  std::string policy;                        // policy that an act names

  /// `body_at` is an offset, since a span would dangle: ZeroMQ may store a small message inside its object, which
  /// moves.
  std::span<const std::byte> body(std::span<const std::byte> request) const {
    return request.subspan(body_at, body_size);
  }
};

/// Reads the fields of a serialized Request, and of an Act in it, without copying one. After an error `envelope` holds
/// the fields read so far, so that the refusal can carry the request's number. Errors: bad_request, incompatible.
Status read_envelope(std::span<const std::byte> request, Envelope& envelope);

/// The refusal for a peer that speaks only versions `min` to `max`.
Error incompatible(std::uint32_t min, std::uint32_t max);

}  // namespace vla::wire
