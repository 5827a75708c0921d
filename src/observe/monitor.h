// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <string>

#include "base/result.h"

namespace vla::serve {

/// HTTP for those who watch the server: `/metrics`, `/healthz` (200 while the process lives) and `/readyz` (200 while
/// acts are taken, else 503 and why not). One thread serves all connections and waits for none of them. A connection
/// has a time to ask and take its answer, and the oldest one makes room where there are too many, so that a slow or
/// broken client blocks no other.
class Monitor {
 public:
  struct Sources {
    std::function<std::string()> metrics;   // text of the exposition format
    std::function<std::string()> obstacle;  // why no act is taken; empty: they are
  };
  /// Listens at once, at HOST:PORT, HOST an IPv4 address, an IPv6 address in brackets, or `*`. An address that others
  /// can reach needs `insecure`: HTTP has no keys. The functions are called on the monitor's thread.
  /// Errors: usage, io, out_of_memory.
  static Result<std::unique_ptr<Monitor>> open(const std::string& address, bool insecure, Sources sources);
  ~Monitor();

  /// What was bound, the port filled in.
  const std::string& address() const;

 private:
  class Http;
  explicit Monitor(std::unique_ptr<Http> http);
  std::unique_ptr<Http> http_;
};

}  // namespace vla::serve
