// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>

/// What clusters, whose blocks combine shares of their work, are assumed to cost on Hopper. Nothing of it is measured.
namespace vla::lower {

constexpr double kCluster = 1.2;    // microseconds of both barriers and of the first read of another block
constexpr double kOfOthers = 20e3;  // bytes that an SM reads from other blocks' shared memory per microsecond
constexpr int kGroupOfSms = 16;     // a cluster's SMs are of one such group

/// SMs that clusters of this many blocks can keep busy.
inline int usable_sms(int n_sm, int n_block) {
  const int n = n_sm / kGroupOfSms * (kGroupOfSms / n_block * n_block) + n_sm % kGroupOfSms / n_block * n_block;
  return std::max(n, n_block);
}
/// Microseconds in which one of `n_split` blocks combines its part of their shares, `share` float32 in each block.
inline double combine_us(double share, int n_split) {
  const double n_read = share / n_split * (n_split - 1);  // of other blocks
  return kCluster + 4 * n_read / kOfOthers;
}

}  // namespace vla::lower
