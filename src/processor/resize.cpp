// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/resize.h"

#include "processor/byte_pixels.h"
#include "processor/resample.h"

namespace vla {
namespace {

/// Interleaved bytes as planes of bytes / 255.
void spread(std::span<const std::uint8_t> rgb, std::span<float> out) {
  const auto& table = byte_table();
  const std::size_t size = rgb.size() / 3;
  for (std::size_t i = 0; i < size; ++i)
    for (std::size_t c = 0; c < 3; ++c) out[c * size + i] = table[rgb[3 * i + c]];
}

}  // namespace

Status resize(const Frame& frame, const Resize& to, std::span<float> out, const std::string& where) {
  const bool opencv = to.filter == Resize::Filter::opencv_bilinear;
  std::vector<std::uint8_t> cut;
  const auto* bytes = std::get_if<std::vector<std::uint8_t>>(&frame.rgb);
  if (bytes == nullptr) {
    if (opencv)
      return Error{Code::bad_observation, where, "pixels of 8 bits", "float pixels",
                   "send the camera's bytes: this policy's pictures are resized as bytes"};
    cut = cut_to_bytes(std::get<std::vector<float>>(frame.rgb));
    bytes = &cut;
  }
  if (frame.width == to.width && frame.height == to.height) {
    spread(*bytes, out);
    return {};
  }
  const auto resample = opencv ? resample_opencv : resample_torch;
  spread(resample(*bytes, frame.width, frame.height, to.width, to.height), out);
  return {};
}

}  // namespace vla
