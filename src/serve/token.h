// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

#include "base/result.h"

namespace vla::serve {

/// Reads the secret that clients of protocols without keys must send: the first line of a file that only its owner may
/// read; empty without a file. Errors: io, usage.
Result<std::string> read_token(const std::string& file);

/// Compares two secrets in constant time for the right length.
bool is_same_secret(std::string_view a, std::string_view b);

}  // namespace vla::serve
