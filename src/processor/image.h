// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <variant>
#include <vector>

#include "base/result.h"

namespace vla {

/// One camera frame: rows top to bottom, RGB interleaved, (height, width, 3); 8 bits, or float32 in [0, 1].
struct Frame {
  int width = 0;
  int height = 0;
  std::variant<std::vector<std::uint8_t>, std::vector<float>> rgb;
  int orientation =
      1;  // EXIF orientation; 2 to 8 ask viewers to turn or mirror the image, which is not done here at all
};

struct ImageLimits {
  std::int64_t max_pixels = 64'000'000;  // compared with a file's header before memory is allocated
  Code over = Code::bad_observation;     // error code for a larger image
};

/// Decodes a PNG, a JPEG or a NumPy array file (uint8 or float32, (height, width, 3), C order), distinguished by
/// content.
///
/// The pixels are those of Pillow after `convert("RGB")`: grey is replicated, palettes are expanded, transparency is
/// dropped without blending. The orientation in EXIF or XMP is not applied, so a file, an array of its pixels and a
/// message with the file give the same answer. Colour profiles and gamma are ignored. Refused: 16-bit PNG and CMYK JPEG
/// (Pillow's conversions of them lose or invert values), JPEG in arithmetic code or of too many scans for its size,
/// anything truncated or corrupt, even if Pillow or libjpeg only warn, and float values outside [0, 1]. `where` names
/// the image in errors. Errors: bad_observation.
Result<Frame> decode_image(std::span<const std::byte> file, const std::string& where, const ImageLimits& limits = {});

/// A PNG file of 8-bit pixels. Errors: out_of_memory.
Result<std::vector<std::byte>> encode_png(const Frame& frame);

/// Checks what `decode_image` guarantees, for frames from other sources: a size within the limits, as many elements as
/// the size says, floats in [0, 1]. Errors: bad_observation.
Status check_frame(const Frame& frame, const std::string& where, const ImageLimits& limits = {});

}  // namespace vla
