// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "net/tcp.h"

#include <fmt/format.h>

#include <charconv>

#include "net/endpoint.h"

namespace vla::net {

using boost::asio::ip::tcp;

Result<tcp::endpoint> tcp_endpoint_of(const std::string& address, const char* option, bool insecure) {
  const auto reach = reach_of("tcp://" + address);
  const std::size_t colon = address.rfind(':');
  std::string host = address.substr(0, colon);
  if (host == "*") host = "0.0.0.0";
  if (host.starts_with('[') && host.ends_with(']')) host = host.substr(1, host.size() - 2);
  boost::system::error_code not_an_address;
  const auto ip = boost::asio::ip::make_address(host, not_an_address);
  if (!reach || address.ends_with(":*") || not_an_address)
    return Error{Code::usage, option, "ADDRESS:PORT", "'" + address + "'", "for example 127.0.0.1:9090"};
  if (*reach == Reach::remote && !insecure)
    return Error{Code::usage, option, "an address of this machine's own, such as 127.0.0.1:9090",
                 address + ", which other machines can reach", "--insecure lets everybody in"};
  unsigned short port = 0;
  std::from_chars(address.data() + colon + 1, address.data() + address.size(), port);
  return tcp::endpoint(ip, port);
}

Result<std::string> bind_tcp(std::optional<Listener<tcp>>& listener, boost::asio::io_context& context,
                             const std::string& address, const char* option, bool insecure) {
  VLA_TRY(const tcp::endpoint endpoint, tcp_endpoint_of(address, option, insecure));
  try {
    listener.emplace(context, endpoint);
    return fmt::format("{}:{}", address.substr(0, address.rfind(':')), listener->endpoint().port());
  } catch (const boost::system::system_error& error) {
    return Error{Code::io, address, "a free address of this machine", error.code().message(),
                 fmt::format("choose another with {}; port 0 takes a free one", option)};
  }
}

}  // namespace vla::net
