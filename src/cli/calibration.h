// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "quantize/search.h"

namespace vla::cli {

/// Reads up to `n_most` acts of a recording that were answered with a chunk, evenly spread, each with its noise.
/// Errors: those of Recording, Bundle::open and the policy; bad_request for a recording of another policy.
Result<std::vector<Judged>> read_observations(const std::string& recording, const std::string& bundle,
                                              std::size_t n_most);

}  // namespace vla::cli
