// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>

#include "net/connections.h"
#include "serve/lerobot/calls.h"

namespace vla::door {

/// gRPC over HTTP/2 at a socket that listens. What each peer may take is counted here, by frames, bytes and calls; the
/// library gets only what is within. Everything happens inside the loop's `wait`.
class Rpcs final : public serve::lerobot::Calls {
 public:
  using Handler = serve::lerobot::CallHandler;
  static constexpr std::size_t kMaxPiece = (2 << 20) + 1024;  // of a call: LeRobot's client cuts at 2 MiB
  static constexpr std::size_t kMaxCalls = 16;                // of a connection at once

  /// Takes the descriptor. `limits.connections` is also how many calls run at once.
  Rpcs(net::Loop& loop, int descriptor, const net::ConnectionLimits& limits);
  ~Rpcs() override;

  /// Takes connections from now on; to be called before every turn of the loop. The handler outlives it.
  void begin(Handler& handler);
  void answer(std::uint64_t id, const std::string& message) override;
  void refuse(std::uint64_t id, const Error& error) noexcept override;
  /// Takes no connection and no call any more.
  void stop();
  bool has_answers() const;
  /// Closes every connection. Call it while the handler lives: it is told of each.
  void end();

 private:
  class All;
  std::unique_ptr<All> all_;
};

}  // namespace vla::door
