// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <variant>
#include <vector>

#include "base/result.h"

namespace vla {

/// The start of the solver: the values themselves, row by row (horizon, d_action), or a seed that draws them.
using Noise = std::variant<std::vector<float>, std::uint64_t>;

/// `count` values of `kind` ("normal": mean 0, deviation 1; "uniform": [-1, 1)) from a seed. The same seed gives the
/// same bytes on every machine: a counter-based generator and a logarithm of our own, no library function whose last
/// bit may differ. Errors: bad_bundle for another kind.
Result<std::vector<float>> draw_noise(const std::string& kind, std::uint64_t seed, std::size_t count);

}  // namespace vla
