// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "base/result.h"

namespace vla::lower {

/// Ways to lower a graph that no GPU has shown yet to be faster. The GPU kit measures acts without each that is used,
/// and with each that is not.
struct CudaWays {
  bool clusters = true;      // blocks of a cluster add the shares of a product, or combine those of attention
  bool adders = true;        // kernels of their own add the shares of products of up to 64 rows
  bool halved_norms = true;  // products begin and end norms
  bool rotations = true;     // products rotate heads
  bool flash = false;        // wgmma multiplies what attention of one segment of keys does (hopper_flash.h)
  bool tma = false;          // TMA fetches the operands of products of more than 64 rows, where its tiles fit
};

/// The ways that VLA_CUDA_WITHOUT and VLA_CUDA_WITH leave: those of CudaWays but for what they name, with commas
/// between names. Errors: usage for another name.
Result<CudaWays> cuda_ways_of_environment();
/// What a device's name says of it: ", without clusters, with tma", or nothing.
std::string text_of(const CudaWays& ways);

}  // namespace vla::lower
