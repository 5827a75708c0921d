// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <initializer_list>

#include "support/param_set.h"

namespace vla::test {

/// Square matrices and vectors of ones, for graphs that are looked at and not computed.
inline std::vector<ParamSet::Piece> ones(std::int64_t width, std::initializer_list<const char*> matrices,
                                         std::initializer_list<const char*> vectors) {
  std::vector<ParamSet::Piece> all;
  for (const char* name : matrices)
    all.push_back({name, {width, width}, std::vector<float>(static_cast<std::size_t>(width * width), 1)});
  for (const char* name : vectors)
    all.push_back({name, {width}, std::vector<float>(static_cast<std::size_t>(width), 1)});
  return all;
}

}  // namespace vla::test
