// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>

namespace vla {

/// Levenshtein distance: how many letters must be added, removed or changed to turn one text into the other.
std::size_t edit_distance(const std::string& a, const std::string& b);

}  // namespace vla
