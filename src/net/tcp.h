// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <boost/asio/ip/tcp.hpp>
#include <optional>
#include <string>

#include "base/result.h"
#include "net/listener.h"

namespace vla::net {

/// Parses ADDRESS:PORT. ADDRESS is an IPv4 address, an IPv6 address in brackets, or `*`; names are not resolved. An
/// address that other hosts can reach needs `insecure`. `option`: the place in errors. Errors: usage.
Result<boost::asio::ip::tcp::endpoint> tcp_endpoint_of(const std::string& address, const char* option, bool insecure);
/// Binds `listener` there. Returns the address with its port. Errors: usage, io.
Result<std::string> bind_tcp(std::optional<Listener<boost::asio::ip::tcp>>& listener, boost::asio::io_context& context,
                             const std::string& address, const char* option, bool insecure);

}  // namespace vla::net
