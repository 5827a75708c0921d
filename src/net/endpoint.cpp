// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "net/endpoint.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include <charconv>
#include <cstring>

namespace vla::net {
namespace {

bool is_port(const std::string& text) {
  if (text == "*") return true;
  unsigned port = 0;
  const char* const end = text.data() + text.size();
  const auto [next, error] = std::from_chars(text.data(), end, port);
  return error == std::errc() && next == end && port <= 65535;
}

bool is_loopback(const in_addr& address) { return (ntohl(address.s_addr) >> 24) == 127; }

bool is_loopback(const in6_addr& address) {
  if (!IN6_IS_ADDR_V4MAPPED(&address)) return IN6_IS_ADDR_LOOPBACK(&address);
  return address.s6_addr[12] == 127;
}

Reach reach_of_host(const std::string& host) {
  in_addr v4;
  in6_addr v6;
  bool loopback = host == "lo";
  if (inet_pton(AF_INET, host.c_str(), &v4) == 1) {
    loopback = is_loopback(v4);
  } else if (host.size() > 2 && host.front() == '[' && host.back() == ']' &&
             inet_pton(AF_INET6, host.substr(1, host.size() - 2).c_str(), &v6) == 1) {
    loopback = is_loopback(v6);
  }
  return loopback ? Reach::local : Reach::remote;
}

}  // namespace

Result<Reach> reach_of(const std::string& endpoint) {
  const Error refused{Code::usage, "--bind", "tcp://ADDRESS:PORT or ipc://PATH", "'" + endpoint + "'",
                      "for example tcp://127.0.0.1:5555"};
  if (endpoint.starts_with("ipc://")) return endpoint.size() > 6 ? Result<Reach>(Reach::local) : refused;
  const std::size_t colon = endpoint.rfind(':');
  if (!endpoint.starts_with("tcp://") || colon < 7 || !is_port(endpoint.substr(colon + 1))) return refused;
  const std::string host = endpoint.substr(6, colon - 6);
  if (host == "localhost" || host.find_first_of("; /") != std::string::npos)
    return Error{Code::usage, "--bind", "an address or an interface, since names are not looked up", "'" + host + "'",
                 "for example tcp://127.0.0.1:5555"};
  return reach_of_host(host);
}

Status check_free(const std::string& endpoint, const std::string& option) {
  const std::string path = endpoint.starts_with("ipc://") ? endpoint.substr(6) : std::string();
  struct stat info;
  if (path.empty() || ::stat(path.c_str(), &info) != 0) return {};
  if (!S_ISSOCK(info.st_mode)) return Error{Code::io, endpoint, "a path of its own", "a file that is no socket"};
  sockaddr_un address = {};
  address.sun_family = AF_UNIX;
  if (path.size() >= sizeof(address.sun_path)) return {};  // too long: binding reports it
  std::memcpy(address.sun_path, path.c_str(), path.size());
  const int fd = ::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
  const bool served = fd >= 0 && ::connect(fd, reinterpret_cast<const sockaddr*>(&address), sizeof(address)) == 0;
  if (fd >= 0) ::close(fd);
  if (!served) return {};
  return Error{Code::io, endpoint, "a free address", "one that a running program serves",
               "stop it, or choose another with " + option};
}

}  // namespace vla::net
