// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <boost/asio/ip/tcp.hpp>
#include <optional>
#include <string>

#include "base/result.h"
#include "net/listener.h"

namespace vla::net {

/// ADDRESS:PORT, ADDRESS an IPv4 address, an IPv6 address in brackets, or `*`; names are not resolved. An address that
/// others can reach needs `insecure`. `option`: where errors are. Errors: usage.
Result<boost::asio::ip::tcp::endpoint> tcp_endpoint_of(const std::string& address, const char* option, bool insecure);
/// Has `listener` take connections there. The address with the port that it got. Errors: usage, io.
Result<std::string> bind_tcp(std::optional<Listener<boost::asio::ip::tcp>>& listener, boost::asio::io_context& context,
                             const std::string& address, const char* option, bool insecure);

}  // namespace vla::net
