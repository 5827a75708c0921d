// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <string>

#include "base/result.h"
#include "processor/image.h"
#include "processor/resize_filters.h"

namespace vla {

/// Resizes to `width` x `height` without keeping the aspect, with one reference's arithmetic.
struct Resize {
  int width = 0;
  int height = 0;
  const ResizeFilter* filter = nullptr;
};

/// Reads "width" and "height", at least two pixels each (torch reads the wrong rows of an image with one column), and
/// "filter", one of those of `op`. Errors: bad_bundle.
Result<Resize> read_resize(JsonFields& fields, std::string_view op);

/// Writes (3, height, width) float32 to `out`: the resized bytes divided by 255, or the output of a filter on planes. A
/// filter on bytes refuses float pixels, because its reference receives bytes, unless its reference truncates floats to
/// bytes. Sources: lerobot policies/evo1/internvl3_embedder.py (_batched_resize_01); lerobot_policy_turbovla
/// modeling_turbovla.py (TurboVLA._encode_images). Errors: bad_observation.
Status resize(const Frame& frame, const Resize& to, std::span<float> out, const std::string& where);

}  // namespace vla
