// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/standardize.h"

#include "base/bf16.h"

namespace vla {
namespace {

float rounded(float x) { return from_bf16(to_bf16(x)); }

void standardize_in_bf16(std::span<float> plane, float mean, float divisor) {
  for (float& x : plane) x = rounded(rounded(rounded(x) - mean) / divisor);
}

}  // namespace

void standardize(std::span<float> pixels, const Standardize& op) {
  const std::size_t size = pixels.size() / op.mean.size();
  for (std::size_t c = 0; c < op.mean.size(); ++c) {
    const std::span<float> plane = pixels.subspan(c * size, size);
    if (op.arithmetic == Standardize::Arithmetic::bfloat16) {
      standardize_in_bf16(plane, rounded(op.mean[c]), rounded(op.std[c]));
      continue;
    }
    const float unit = op.arithmetic == Standardize::Arithmetic::float32_in_bytes ? 255.0f : 1.0f;
    const float mean = unit * op.mean[c], divisor = unit * op.std[c];
    for (float& x : plane) x = (unit * x - mean) / divisor;
    if (op.arithmetic == Standardize::Arithmetic::float32_then_bfloat16)
      for (float& x : plane) x = rounded(x);
  }
}

}  // namespace vla
