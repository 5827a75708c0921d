// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "base/result.h"

namespace vla::lower {

/// Ways to lower a graph that can be left out, because no GPU has shown yet that they are faster. The GPU kit measures
/// acts without each.
struct CudaWays {
  bool clusters = true;      // blocks of a cluster add the shares of a product, or combine those of attention
  bool adders = true;        // kernels of their own add the shares of products of up to 64 rows
  bool halved_norms = true;  // products begin and end RMS norms
  bool rotations = true;     // products rotate heads
};

/// All ways but those that `without` names, with commas between them; null names none. Errors: usage for another name.
Result<CudaWays> cuda_ways(const char* without);
/// What a device's name says of it: ", without clusters", or nothing if all ways are used.
std::string text_of(const CudaWays& ways);

}  // namespace vla::lower
