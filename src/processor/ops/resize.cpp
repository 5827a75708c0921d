// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/resize.h"

#include "processor/byte_pixels.h"
#include "processor/json_fields.h"
#include "processor/ops/letterbox.h"
#include "processor/ops/pipeline.h"
#include "processor/recipe.h"
#include "processor/resample.h"

namespace vla {

Status resize(const Frame& frame, const Resize& to, std::span<float> out, const std::string& where) {
  if (to.filter == Resize::Filter::torch_bilinear) return stretch(frame, to.width, to.height, out), Status();
  const bool opencv = to.filter == Resize::Filter::opencv_bilinear;
  std::vector<std::uint8_t> cut;
  const auto* bytes = std::get_if<std::vector<std::uint8_t>>(&frame.rgb);
  if (bytes == nullptr) {
    if (opencv)
      return Error{Code::bad_observation, where, "pixels of 8 bits", "float pixels",
                   "send the camera's bytes: this policy's images are resized as bytes"};
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

namespace {

Result<Resize> read_resize(JsonFields& fields) {
  constexpr int kMinSide = 2;  // torch reads the wrong rows of an image with one column
  Resize op;
  VLA_TRY(op.width, fields.integer("width", kMinSide, kMaxImageSide));
  VLA_TRY(op.height, fields.integer("height", kMinSide, kMaxImageSide));
  VLA_TRY(const int filter, fields.choice("filter", {"opencv_bilinear", "torch_bicubic_8bit", "torch_bilinear"}));
  op.filter = static_cast<Resize::Filter>(filter);
  return op;
}

/// As the first op it makes the planes; later in the list it is one of several ops on bytes.
Status parse(JsonFields& fields, Recipe& recipe) {
  if (recipe.fit != nullptr) return parse_byte_resize(fields, recipe);
  VLA_TRY(const Resize op, read_resize(fields));
  recipe.fit = std::make_unique<OneFit<Resize>>("resized", resize, op);
  recipe.width = op.width;
  recipe.height = op.height;
  return {};
}

}  // namespace

Ops resize_ops() { return {{"image", "resize", parse}}; }

}  // namespace vla
