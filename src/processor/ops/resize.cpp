// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/resize.h"

#include "processor/byte_pixels.h"
#include "processor/json_fields.h"
#include "processor/ops/pipeline.h"
#include "processor/recipe.h"

namespace vla {

Result<Resize> read_resize(JsonFields& fields, std::string_view op) {
  constexpr int kMinSide = 2;
  Resize resize;
  VLA_TRY(resize.width, fields.integer("width", kMinSide, kMaxImageSide));
  VLA_TRY(resize.height, fields.integer("height", kMinSide, kMaxImageSide));
  VLA_TRY(resize.filter, read_resize_filter(fields, op));
  return resize;
}

Status resize(const Frame& frame, const Resize& to, std::span<float> out, const std::string& where) {
  if (const auto* planes = std::get_if<ResizeToPlanes>(&to.filter->resize))
    return (*planes)(frame, to.width, to.height, out), Status();
  std::vector<std::uint8_t> cut;
  const auto* bytes = std::get_if<std::vector<std::uint8_t>>(&frame.rgb);
  if (bytes == nullptr) {
    if (!to.filter->cuts_floats)
      return Error{Code::bad_observation, where, "pixels of 8 bits", "float pixels",
                   "send the camera's bytes: this policy's images are resized as bytes"};
    cut = cut_to_bytes(std::get<std::vector<float>>(frame.rgb));
    bytes = &cut;
  }
  const auto resample = std::get<ResizeBytes>(to.filter->resize);
  spread_bytes(resample(*bytes, frame.width, frame.height, to.width, to.height), out);
  return {};
}

namespace {

/// As the first op it writes the planes; after other ops it is one of several ops on bytes.
Status parse_resize(JsonFields& fields, Recipe& recipe) {
  if (recipe.fit != nullptr) return parse_byte_resize(fields, recipe);
  VLA_TRY(const Resize op, read_resize(fields, "resize"));
  recipe.fit = std::make_unique<OneFit<Resize>>("resized", resize, op);
  recipe.width = op.width;
  recipe.height = op.height;
  return {};
}

}  // namespace

Ops resize_ops() { return {{"image", "resize", parse_resize}}; }

}  // namespace vla
