// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "quantize/search.h"

namespace vla::cli {

/// At most so many acts of a recording that were answered with a chunk, evenly spread, each with the noise that it had.
/// Errors: those of Recording; those of Bundle::open and the policy; bad_request for a recording of another policy.
Result<std::vector<Judged>> read_observations(const std::string& recording, const std::string& bundle,
                                              std::size_t n_most);

}  // namespace vla::cli
