// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <set>
#include <string>

#include "base/result.h"
#include "zmtp/curve_session.h"

namespace vla::zmtp {

/// CURVE keys are 40 characters of Z85 (ZeroMQ RFC 32) in a text file. A secret key's file has one line. A file of
/// public keys has one key per line; text after a space is a remark, and lines that start with `# ` are remarks.

/// Writes a new pair: PREFIX.secret, readable by its owner only, and PREFIX.public. Errors: io, also if one exists.
Status write_key_pair(const std::string& prefix);
/// Errors: io; usage if the file has other contents or others may read it.
Result<std::string> read_secret_key(const std::string& file);
/// Errors: io; usage if the file has other contents than keys, or none.
Result<std::set<std::string>> read_public_keys(const std::string& file);
/// The public key that belongs to a secret key. Errors: usage.
Result<std::string> public_key_of(const std::string& secret);

/// Reads the server's secret key and its clients' public keys. Errors: those of the two files.
Result<CurveKeys> read_keys(const std::string& secret_file, const std::string& clients_file);

}  // namespace vla::zmtp
