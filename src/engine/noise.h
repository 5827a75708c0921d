// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <variant>
#include <vector>

#include "base/result.h"

namespace vla {

/// The noise of an act, which is the solver's start followed by the noise of each step that adds some: the values,
/// (noise_rows, d_action), or a seed to draw them from.
using Noise = std::variant<std::vector<float>, std::uint64_t>;

/// Draws `count` values of `kind` ("normal": mean 0, deviation 1; "uniform": [-1, 1)). The same seed gives the same
/// bytes on every machine: the generator is counter-based, and the logarithm is our own, because library functions
/// differ in the last bit. Errors: bad_bundle for another kind.
Result<std::vector<float>> draw_noise(const std::string& kind, std::uint64_t seed, std::size_t count);

}  // namespace vla
