// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <span>
#include <string>

#include "base/result.h"
#include "processor/image.h"
#include "processor/ops/op.h"

namespace vla {

/// Fits a frame of any size into `width` x `height`: keeps the aspect and fills the rest with `fill`.
struct Letterbox {
  enum class Align { bottom_right, center };

  int width = 0;
  int height = 0;
  std::array<float, 3> fill = {};  // per channel
  // position of the image; of an odd padding, `center` puts the smaller half at the left and top
  Align align = Align::bottom_right;
  bool antialias = false;  // resamples like Pillow on 8-bit images, see below
};

/// Writes (3, height, width) float32 to `out`; 8-bit values are divided by 255. A frame that already has the size is
/// copied. Otherwise it is resampled bilinearly, without antialiasing, to the largest size that fits.
///
/// The result equals torch's bit for bit on machines where torch uses fused multiply-add: sizes are truncated from
/// double, source positions are rounded once to float32, and the four taps are summed in torch's order. Source: lerobot
/// policies/common/vla_utils.py resize_with_pad, resize_with_pad_torch; torch F.interpolate(mode="bilinear",
/// align_corners=False).
///
/// With `antialias` everything is computed in 8 bits, and a float frame is first truncated to bytes (255 x); the result
/// equals Pillow's. Source: openpi image_tools.py resize_with_pad; `resample_pillow_bilinear`.
///
/// Errors: bad_observation when a side of the resized image is shorter than a pixel.
Status letterbox(const Frame& frame, const Letterbox& to, std::span<float> out, const std::string& where);

/// The same for some rows of `out`; the other rows do not change.
Status letterbox_rows(const Frame& frame, const Letterbox& to, Rows rows, std::span<float> out,
                      const std::string& where);

/// The same resampling to `width` x `height` without keeping the aspect.
void stretch(const Frame& frame, int width, int height, std::span<float> out);

}  // namespace vla
