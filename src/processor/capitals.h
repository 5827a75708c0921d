// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <span>

namespace vla {

/// A range of capitals: every `step`-th code point from `first` to `last`; the small letter is `distance` away.
struct Capitals {
  std::uint32_t first, last, step;
  std::int32_t distance;
};

/// The small letter of a code point by a sorted table, or the code point itself.
inline std::uint32_t small_letter(std::span<const Capitals> table, std::uint32_t c) {
  const auto after = std::upper_bound(table.begin(), table.end(), c, [](std::uint32_t code_point, const Capitals& run) {
    return code_point < run.first;
  });
  if (after == table.begin()) return c;
  const Capitals& run = *std::prev(after);
  if (c > run.last || (c - run.first) % run.step != 0) return c;
  return static_cast<std::uint32_t>(static_cast<std::int32_t>(c) + run.distance);
}

}  // namespace vla
