// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/cuda_ways.h"

#include <algorithm>
#include <sstream>

namespace vla::lower {
namespace {

struct Way {
  const char* name;
  bool CudaWays::*is_used;
};
constexpr Way kWays[] = {{"clusters", &CudaWays::clusters},
                         {"adders", &CudaWays::adders},
                         {"halved-norms", &CudaWays::halved_norms},
                         {"rotations", &CudaWays::rotations}};

}  // namespace

Result<CudaWays> cuda_ways(const char* without) {
  CudaWays ways;
  std::istringstream names(without == nullptr ? "" : without);
  for (std::string name; std::getline(names, name, ',');) {
    const auto* const way = std::ranges::find_if(kWays, [&](const Way& one) { return name == one.name; });
    if (way == std::end(kWays)) {
      std::string all;
      for (const Way& one : kWays) all += (all.empty() ? "" : ", ") + std::string(one.name);
      return Error{Code::usage, "VLA_CUDA_WITHOUT", "names of " + all + ", with commas between them", name};
    }
    ways.*way->is_used = false;
  }
  return ways;
}

std::string text_of(const CudaWays& ways) {
  std::string text;
  for (const Way& way : kWays)
    if (!(ways.*way.is_used)) text += (text.empty() ? ", without " : ", ") + std::string(way.name);
  return text;
}

}  // namespace vla::lower
