// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/cuda_ways.h"

#include <algorithm>
#include <cstdlib>
#include <span>
#include <sstream>

namespace vla::lower {
namespace {

struct Way {
  const char* name;
  bool CudaWays::*is_used;
};
constexpr Way kUsed[] = {{"clusters", &CudaWays::clusters},
                         {"adders", &CudaWays::adders},
                         {"halved-norms", &CudaWays::halved_norms},
                         {"rotations", &CudaWays::rotations}};
constexpr Way kUnused[] = {{"flash", &CudaWays::flash}, {"tma", &CudaWays::tma}};

/// Sets the ways that an environment variable names.
Status set(const char* variable, std::span<const Way> known, bool is_used, CudaWays& ways) {
  const char* const value = std::getenv(variable);
  std::istringstream names(value == nullptr ? "" : value);
  for (std::string name; std::getline(names, name, ',');) {
    const auto way = std::ranges::find_if(known, [&](const Way& one) { return name == one.name; });
    if (way == known.end()) {
      std::string all;
      for (const Way& one : known) all += (all.empty() ? "" : ", ") + std::string(one.name);
      return Error{Code::usage, variable, "names of " + all + ", with commas between them", name};
    }
    ways.*way->is_used = is_used;
  }
  return {};
}
/// The names of ways that are used, or not, after `word`.
std::string names_of(const CudaWays& ways, std::span<const Way> known, bool is_used, const char* word) {
  std::string text;
  for (const Way& way : known)
    if (ways.*way.is_used == is_used) text += (text.empty() ? word : ", ") + std::string(way.name);
  return text;
}

}  // namespace

Result<CudaWays> cuda_ways_of_environment() {
  CudaWays ways;
  VLA_CHECK(set("VLA_CUDA_WITHOUT", kUsed, false, ways));
  VLA_CHECK(set("VLA_CUDA_WITH", kUnused, true, ways));
  return ways;
}

std::string text_of(const CudaWays& ways) {
  return names_of(ways, kUsed, false, ", without ") + names_of(ways, kUnused, true, ", with ");
}

}  // namespace vla::lower
