// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "observe/monitor.h"

namespace vla::observe {
namespace {

HttpReply reply_to(const Monitor::Sources& sources, const std::string& path) {
  if (path == "/healthz") return {.body = "ok\n"};
  if (path == "/metrics") return {.type = "text/plain; version=0.0.4; charset=utf-8", .body = sources.metrics()};
  if (path != "/readyz") return {.status = 404, .body = "/metrics, /healthz and /readyz are here\n"};
  const std::string not_ready_reason = sources.not_ready_reason();
  if (not_ready_reason.empty()) return {.body = "ready\n"};
  return {.status = 503, .body = not_ready_reason + "\n"};
}

}  // namespace

Result<std::unique_ptr<Monitor>> Monitor::open(const std::string& address, bool insecure, Sources sources) {
  const auto handle = [sources = std::move(sources)](const std::string& path, const std::string&) {
    return reply_to(sources, path);
  };
  VLA_TRY(std::unique_ptr<Http> http, Http::open(address, "--metrics", insecure, handle));
  return std::unique_ptr<Monitor>(new Monitor(std::move(http)));
}

}  // namespace vla::observe
