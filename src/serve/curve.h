// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <set>
#include <string>
#include <zmq.hpp>

#include "base/result.h"

namespace vla::serve {

/// CURVE keys are 40 characters of Z85 (ZeroMQ RFC 32) in a text file. A secret key's file has that one line. A file of
/// public keys has one key in a line, anything after a space being a remark; lines that start with `# ` are remarks.

/// Writes a fresh pair: PREFIX.secret, which only the owner may read, and PREFIX.public. Errors: io where one exists.
Status write_key_pair(const std::string& prefix);
/// Errors: io, usage for a file that holds something else or that others may read.
Result<std::string> read_secret_key(const std::string& file);
/// Errors: io, usage for a file with anything but keys, or with none.
Result<std::set<std::string>> read_public_keys(const std::string& file);
/// The public key of a secret one. Errors: usage.
Result<std::string> public_key_of(const std::string& secret);

/// Admits the clients whose keys are listed. ZeroMQ asks it during every handshake (RFC 27, ZAP), over `socket`.
class Gate {
 public:
  /// One per context, bound before the socket that it guards.
  Gate(zmq::context_t& context, std::set<std::string> clients);

  zmq::socket_t& socket() { return socket_; }
  /// Answers one question that `socket` has. The address of the client, where it is refused.
  std::optional<std::string> answer();

 private:
  zmq::socket_t socket_;
  std::set<std::string> clients_;  // public keys, Z85
};

}  // namespace vla::serve
