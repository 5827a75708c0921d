// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/resize.h"

#include "processor/byte_pixels.h"
#include "processor/resample.h"

namespace vla {

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
    spread_bytes(*bytes, out);
    return {};
  }
  const auto resample = opencv ? resample_opencv : resample_torch;
  spread_bytes(resample(*bytes, frame.width, frame.height, to.width, to.height), out);
  return {};
}

}  // namespace vla
