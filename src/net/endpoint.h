// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "base/result.h"

namespace vla::net {

/// Whom an address to bind lets in.
enum class Reach {
  local,  // this machine: ipc, the loopback addresses, the interface `lo`
  remote  // anybody who can route to it
};

/// Reads an endpoint of ZeroMQ: `tcp://HOST:PORT`, HOST an IPv4 address, an IPv6 address in brackets, the name of an
/// interface, or `*` for all of them, PORT a number, 0 or `*` for a free one; or `ipc://PATH`. What is not known to be
/// local is remote. Errors: usage.
Result<Reach> reach_of(const std::string& endpoint);

/// A file at an ipc path is removed before it is bound. Anything but a socket without a server is refused here.
/// `option`: the one that gave the endpoint. Errors: io.
Status check_free(const std::string& endpoint, const std::string& option);

}  // namespace vla::net
