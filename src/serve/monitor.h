// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <string>

#include "base/result.h"

struct mg_context;

namespace vla::serve {

/// HTTP for those who watch the server: `/metrics`, `/healthz` (200 while the process lives) and `/readyz` (200 while
/// acts are taken, else 503 and why not). A few threads of its own, with limits on time and size, so that whoever asks
/// slowly or badly disturbs nobody but others who ask here.
class Monitor {
 public:
  struct Sources {
    std::function<std::string()> metrics;   // text of the exposition format
    std::function<std::string()> obstacle;  // why no act is taken; empty: they are
  };
  /// Listens at once, at HOST:PORT, HOST an IPv4 address, an IPv6 address in brackets (where CivetWeb was
  /// built with IPv6; Debian's is not), or `*`. An address that others
  /// can reach needs `insecure`: nobody is asked for a key here. The functions are called from any thread.
  /// Errors: usage, io.
  static Result<std::unique_ptr<Monitor>> open(const std::string& address, bool insecure, Sources sources);
  ~Monitor();

  /// What was bound, the port filled in.
  const std::string& address() const { return address_; }
  const Sources& sources() const { return sources_; }

 private:
  explicit Monitor(Sources sources) : sources_(std::move(sources)) {}
  Status start(const std::string& address);
  Sources sources_;
  std::string address_;
  mg_context* context_ = nullptr;
};

}  // namespace vla::serve
