// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// Loops of multiply-adds on registers. Each loop has as many sums as registers allow, so that no multiply-add waits for
// the previous one. Each sum starts at a different value, so that the compiler cannot merge equal sums.
#include <algorithm>

#include "kernels/machine_kernels.h"

namespace vla::kernels {
namespace {

thread_local volatile float sink;  // stored so that the compiler must compute it

/// Factors that keep every sum finite and normal: x <- 0.999 x + 0.001 tends to 1.
constexpr float kFactor = 0.999f, kTerm = 0.001f;

void multiply_add_any(long n_round) {
  using Vector [[gnu::vector_size(16)]] = float;
  Vector sums[8];
#pragma GCC unroll 8
  for (int i = 0; i < 8; ++i) sums[i] = Vector{} + static_cast<float>(i);
  for (; n_round > 0; --n_round)
#pragma GCC unroll 8
    for (Vector& s : sums) s = s * kFactor + kTerm;
  for (const Vector& s : sums) sink = s[0];
}

std::vector<PeakProbe> detect() {
  std::vector<PeakProbe> found = {{"baseline f32", {}, Number::f32, 8 * 4 * 2, multiply_add_any}};
  for (const PeakProbe& probe : machine::peak_probes())
    if (this_cpu().has_all(probe.needs)) found.push_back(probe);
  return found;
}

}  // namespace

const std::vector<PeakProbe>& peak_probes() {
  static const std::vector<PeakProbe> probes = detect();
  return probes;
}

const PeakProbe& peak_probe_of(Features use) {
  const PeakProbe* best = &peak_probes().front();
  for (const PeakProbe& probe : peak_probes())
    if (use.empty() ? probe.number == Number::f32 : use.has_all(probe.needs) && probe.number < Number::int8)
      best = &probe;
  return *best;
}

const PeakProbe* int8_probe_of(Features use, bool ternary) {
  const PeakProbe* best = nullptr;
  for (const PeakProbe& probe : peak_probes())
    if ((probe.number == Number::int8 || (ternary && probe.number == Number::ternary)) && use.has_all(probe.needs))
      best = &probe;
  return best;
}

}  // namespace vla::kernels
