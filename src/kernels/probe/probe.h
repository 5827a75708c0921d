// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "kernels/kernel_set.h"

namespace vla::kernels {

enum class Number { f32, bf16, int8, ternary };

/// A loop of multiply-adds on registers alone: as fast as the machine can multiply with these instructions.
struct PeakProbe {
  std::string name;  // "avx2 f32"
  Features needs;
  Number number;        // what is multiplied; sums are f32, or int32 for int8 and ternary
  double op_per_round;  // two for each multiply-add
  void (*run)(long n_round);
};

/// Every loop that this machine can run, the slowest instructions first.
const std::vector<PeakProbe>& peak_probes();

/// The loop in whose rate the speed of these kernels is measured: that of the kernels' own products, and the fastest in
/// float32 where they use no features, which is ggml.
const PeakProbe& peak_probe_of(Features use);
/// The same of their products of int8 codes, by weights that are ternary or int8; null where these are made without
/// such instructions.
const PeakProbe* int8_probe_of(Features use, bool ternary);

/// Operations per second of `n_thread` threads that run the loop side by side, in wall time. The best of many short
/// bursts within about `seconds`: what the machine can do now, not what other programs leave of it.
double measure_peak(const PeakProbe& probe, int n_thread, double seconds);

/// Bytes per second that `n_thread` threads read side by side from a memory several times larger than the L3 cache,
/// in wall time; the best of the passes within about `seconds`, of which the first pass takes as long as it needs.
/// 0 where the system does not give the memory.
double measure_read_bandwidth(int n_thread, double seconds);

}  // namespace vla::kernels
