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

/// Checks before binding that no process serves an ipc path; a stale socket there is allowed. `option`: the option that
/// gave the endpoint. Errors: io, for a socket that is being served and for any other file.
Status check_free(const std::string& endpoint, const std::string& option);

}  // namespace vla::net
