// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "observe/http.h"

namespace vla::observe {

/// HTTP for monitoring programs: `/metrics`, `/healthz` (200 while the process lives) and `/readyz` (200 while acts are
/// taken, else 503 with the reason).
class Monitor {
 public:
  struct Sources {
    std::function<std::string()> metrics;           // text in exposition format
    std::function<std::string()> not_ready_reason;  // why no acts are taken; empty if they are
  };
  /// As Http::open. The functions are called on Http's thread.
  static Result<std::unique_ptr<Monitor>> open(const std::string& address, bool insecure, Sources sources);

  const std::string& address() const { return http_->address(); }

 private:
  explicit Monitor(std::unique_ptr<Http> http) : http_(std::move(http)) {}
  std::unique_ptr<Http> http_;
};

}  // namespace vla::observe
