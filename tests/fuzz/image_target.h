// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdlib>
#include <span>

#include "processor/image.h"
#include "processor/ops/letterbox.h"

namespace vla::fuzz {

/// Decodes bytes as an image; what is accepted must be a sound frame that letterboxes. Aborts when it is not.
inline void check_image(std::span<const std::byte> bytes) {
  constexpr ImageLimits kLimits{1 << 18};  // small, so that the time goes into the decoders and not into memory
  const auto frame = decode_image(bytes, "input", kLimits);
  if (!frame) return;
  if (!check_frame(*frame, "input", kLimits)) std::abort();
  std::vector<float> out(3 * 20 * 16, -1.0f);
  if (!letterbox(*frame, {20, 16, 0.0f}, out, "input")) return;
  for (const float value : out)
    if (!(value >= 0.0f && value <= 1.00001f)) std::abort();  // weights sum to 1 within rounding
}

}  // namespace vla::fuzz
