// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "kernels/kernel_set.h"

namespace vla::kernels {

enum class Number { f32, bf16, int8, ternary };

/// A loop of multiply-adds on registers: the peak rate of these instructions on this machine.
struct PeakProbe {
  std::string name;  // "avx2 f32"
  Features needs;
  Number number;        // operand type; sums are f32, or int32 for int8 and ternary
  double op_per_round;  // operations per round, two per multiply-add
  void (*run)(long n_round);
};

/// All loops that this machine can run, slowest instructions first.
const std::vector<PeakProbe>& peak_probes();

/// The loop that the speed of kernels with these features is compared with: the one with the instructions of their
/// products, or, for ggml, which has no features, the fastest one in float32.
const PeakProbe& peak_probe_of(Features use);
/// The same for products of int8 codes with ternary or int8 weights; null if no feature has such instructions.
const PeakProbe* int8_probe_of(Features use, bool ternary);

/// Operations per second (wall time) of `n_thread` threads that run the loop at once: the best of many short bursts
/// within about `seconds`. The best burst is the machine's own rate, even if other programs slow down other bursts.
double measure_peak(const PeakProbe& probe, int n_thread, double seconds);

/// Bytes per second (wall time) that `n_thread` threads read from memory several times larger than L3: the best pass
/// within about `seconds`, and at least one whole pass. 0 if the memory cannot be allocated.
double measure_read_bandwidth(int n_thread, double seconds);

}  // namespace vla::kernels
