// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>

#include "net/connections.h"
#include "serve/lerobot/calls.h"

namespace vla::door {

/// A gRPC server over HTTP/2. It counts each peer's frames, bytes and calls before the library sees them, and forwards
/// only what is within the limits. All work happens inside the event loop's `wait`.
class Rpcs final : public serve::lerobot::Calls {
 public:
  using Handler = serve::lerobot::CallHandler;
  static constexpr std::size_t kMaxPiece = (2 << 20) + 1024;  // bytes of a message; LeRobot's client splits at 2 MiB
  static constexpr std::size_t kMaxCalls = 16;                // per connection at once

  /// Takes ownership of the descriptor. `limits.connections` also limits the calls that run at once.
  Rpcs(net::Loop& loop, int descriptor, const net::ConnectionLimits& limits);
  ~Rpcs() override;

  /// Accepts connections from now on; call it before every turn of the loop. The handler must outlive it.
  void begin(Handler& handler);
  void answer(std::uint64_t id, const std::string& message) override;
  void refuse(std::uint64_t id, const Error& error) noexcept override;
  /// Stops accepting connections and calls.
  void stop();
  bool has_answers() const;
  /// Closes every connection and tells the handler of each; the handler must still exist.
  void end();

 private:
  class All;
  std::unique_ptr<All> all_;
};

}  // namespace vla::door
