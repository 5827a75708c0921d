// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/monitor.h"

#include <arpa/inet.h>
#include <civetweb.h>
#include <fmt/format.h>
#include <pthread.h>

#include <csignal>
#include <exception>
#include <string_view>

#include "serve/endpoint.h"

namespace vla::serve {
namespace {

struct Reply {
  int status;
  const char* reason;
  std::string body;
  const char* type = "text/plain; charset=utf-8";
};

Reply reply_to(const Monitor::Sources& sources, std::string_view method, std::string_view path) {
  if (method != "GET" && method != "HEAD") return {405, "Method Not Allowed", "GET only\n"};
  if (path == "/healthz") return {200, "OK", "ok\n"};
  if (path == "/metrics") return {200, "OK", sources.metrics(), "text/plain; version=0.0.4; charset=utf-8"};
  if (path != "/readyz") return {404, "Not Found", "/metrics, /healthz and /readyz are here\n"};
  const std::string obstacle = sources.obstacle();
  return obstacle.empty() ? Reply{200, "OK", "ready\n"} : Reply{503, "Service Unavailable", obstacle + "\n"};
}

int answer(mg_connection* connection) noexcept {
  const mg_request_info& request = *mg_get_request_info(connection);
  const auto& monitor = *static_cast<const Monitor*>(request.user_data);
  Reply reply = {};
  try {
    reply = reply_to(monitor.sources(), request.request_method, request.local_uri ? request.local_uri : "");
  } catch (const std::exception&) {  // no memory: this one asks again later
    reply = {500, "Internal Server Error", ""};
  }
  const bool has_body = std::string_view(request.request_method) != "HEAD";
  mg_printf(connection,
            "HTTP/1.1 %d %s\r\nContent-Type: %s\r\nContent-Length: %zu\r\nCache-Control: no-store\r\n"
            "Connection: close\r\n\r\n",
            reply.status, reply.reason, reply.type, reply.body.size());
  if (has_body) mg_write(connection, reply.body.data(), reply.body.size());
  return reply.status;
}

/// What the library has to say is said by the answer or by `start`.
int say_nothing(const mg_connection*, const char*) noexcept { return 1; }

/// Names are not looked up: what is bound is what stands there.
bool is_number(const std::string& host) {
  in6_addr ignored;
  if (host == "*") return true;
  if (host.size() > 2 && host.front() == '[' && host.back() == ']')
    return inet_pton(AF_INET6, host.substr(1, host.size() - 2).c_str(), &ignored) == 1;
  return inet_pton(AF_INET, host.c_str(), &ignored) == 1;
}

}  // namespace

Result<std::unique_ptr<Monitor>> Monitor::open(const std::string& address, bool insecure, Sources sources) {
  const std::size_t colon = address.rfind(':');
  const auto reach = reach_of("tcp://" + address);
  if (!reach || address.ends_with(":*") || !is_number(address.substr(0, colon)))
    return Error{Code::usage, "--metrics", "ADDRESS:PORT", "'" + address + "'", "for example 127.0.0.1:9090"};
  if (*reach == Reach::remote && !insecure)
    return Error{Code::usage, "--metrics", "an address of this machine's own, such as 127.0.0.1:9090",
                 address + ", which other machines can reach", "--insecure lets everybody in"};
  std::unique_ptr<Monitor> monitor(new Monitor(std::move(sources)));
  VLA_CHECK(monitor->start(address));
  return monitor;
}

Status Monitor::start(const std::string& address) {
  const std::size_t colon = address.rfind(':');
  const std::string host = address.substr(0, colon), listen = host == "*" ? address.substr(colon + 1) : address;
  const char* options[] = {
      "listening_ports",   listen.c_str(), "num_threads", "4", "request_timeout_ms", "2000", "max_request_size", "4096",
      "enable_keep_alive", "no",           nullptr};
  mg_callbacks callbacks = {};
  callbacks.begin_request = answer;
  callbacks.log_message = say_nothing;
  sigset_t all, before;  // signals belong to the caller's threads
  sigfillset(&all);
  pthread_sigmask(SIG_SETMASK, &all, &before);
  mg_init_library(0);
  context_ = mg_start(&callbacks, this, options);
  pthread_sigmask(SIG_SETMASK, &before, nullptr);
  mg_server_port port = {};
  if (context_ == nullptr || mg_get_server_ports(context_, 1, &port) != 1)
    return Error{Code::io, address, "a free address of this machine", "one that cannot be bound",
                 "choose another with --metrics; port 0 takes a free one"};
  address_ = fmt::format("{}:{}", host, port.port);
  return {};
}

Monitor::~Monitor() {
  if (context_ != nullptr) mg_stop(context_);
  mg_exit_library();
}

}  // namespace vla::serve
