// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "base/result.h"

namespace vla {

/// The bytes of a regular file of at most `limit` bytes. Errors: io, naming the path.
Result<std::vector<std::byte>> read_file(const std::string& path, std::size_t limit);

}  // namespace vla
