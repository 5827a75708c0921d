// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>

namespace vla {

/// Letters to be added, removed or changed to make one of the other (Levenshtein).
std::size_t edit_distance(const std::string& a, const std::string& b);

}  // namespace vla
