// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

#include "base/result.h"

namespace vla::serve {

/// The secret that clients of protocols without keys have to send: the first line of a file that only its owner may
/// read; empty without a file. Errors: io, usage.
Result<std::string> read_token(const std::string& file);

/// Whether two secrets are the same; takes as long for every one of the right length.
bool is_same_secret(std::string_view a, std::string_view b);

}  // namespace vla::serve
