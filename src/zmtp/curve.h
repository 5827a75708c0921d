// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <set>
#include <string>

#include "base/result.h"
#include "zmtp/curve_session.h"

namespace vla::zmtp {

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

/// Reads the keys that a server knows. Errors: those of the two files.
Result<CurveKeys> read_keys(const std::string& secret_file, const std::string& clients_file);

}  // namespace vla::zmtp
