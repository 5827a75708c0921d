// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "base/result.h"

namespace vla::net {

/// Who can reach a bound address.
enum class Reach {
  local,  // this machine only: ipc, loopback addresses, the interface `lo`
  remote  // every host with a route to it
};

/// Parses a ZeroMQ endpoint: `tcp://HOST:PORT` or `ipc://PATH`. HOST is an IPv4 address, an IPv6 address in brackets,
/// an interface, or `*` for all. PORT is a number; 0 or `*` selects a free one. An address that is not known to be
/// local counts as remote. Errors: usage.
Result<Reach> reach_of(const std::string& endpoint);

/// Removes a stale socket at an ipc path before binding. Refuses any other file, and a socket that is being served.
/// `option`: the option that gave the endpoint. Errors: io.
Status check_free(const std::string& endpoint, const std::string& option);

}  // namespace vla::net
