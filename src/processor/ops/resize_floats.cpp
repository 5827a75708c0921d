// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/resize_floats.h"

#include <fmt/format.h>

#include "processor/byte_pixels.h"
#include "processor/json_fields.h"
#include "processor/ops/pipeline.h"
#include "processor/recipe.h"

namespace vla {
namespace {

std::vector<float> float_pixels(const Frame& frame) {
  if (const auto* floats = std::get_if<std::vector<float>>(&frame.rgb)) return *floats;
  std::vector<float> pixels;
  for (const std::uint8_t byte : std::get<std::vector<std::uint8_t>>(frame.rgb)) pixels.push_back(byte_table()[byte]);
  return pixels;
}

}  // namespace

Status resize_floats(const Frame& frame, const FloatResizes& to, std::span<float> out, const std::string& where) {
  if (to.camera) VLA_CHECK(check_camera(frame, *to.camera, where));
  std::vector<float> pixels = float_pixels(frame);
  int width = frame.width, height = frame.height;
  for (const Resize& size : to.sizes) {
    if (size.width == width && size.height == height) continue;
    const auto resample = std::get<ResizeFloats>(size.filter->resize);
    pixels = resample(std::move(pixels), width, height, size.width, size.height);
    width = size.width;
    height = size.height;
  }
  const CameraSize kept = to.crop.value_or(CameraSize{width, height});
  const int left = half_to_even(width - kept.width), top = half_to_even(height - kept.height);
  std::size_t at = 0;
  for (std::size_t c = 0; c < 3; ++c)
    for (int y = top; y < top + kept.height; ++y)
      for (int x = left; x < left + kept.width; ++x)
        out[at++] =
            pixels[3 * (static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x)) +
                   c];
  return {};
}

namespace {

constexpr int kMinSide = 2;
constexpr std::size_t kMaxSizes = 4;

struct FloatFit final : OneFit<FloatResizes> {
  FloatFit() : OneFit("resized", resize_floats) {}
  std::optional<CameraSize> camera_size(int /*view*/) const override { return op.camera; }
  FloatResizes* float_resizes() override { return &op; }
};

Result<Resize> read_size(JsonFields& fields) {
  VLA_TRY(const Resize op, read_resize(fields, "resize_floats"));
  if (std::int64_t{op.width} * op.height > ImageLimits().max_pixels)
    return fields.wrong("height", fmt::format("at most {} pixels", ImageLimits().max_pixels));
  return op;
}

/// Consecutive resize_floats ops form one fit. The first may name the only frame size that is accepted.
Status parse_resize_floats(JsonFields& fields, Recipe& recipe) {
  FloatResizes* const before = recipe.fit != nullptr ? recipe.fit->float_resizes() : nullptr;
  if ((recipe.fit != nullptr && before == nullptr) || !recipe.image.empty() || (before != nullptr && before->crop))
    return misplaced(fields, "resize_floats as the first ops on images");
  std::vector<Resize>* sizes = before != nullptr ? &before->sizes : nullptr;
  if (sizes != nullptr && sizes->size() == kMaxSizes) return misplaced(fields, "fewer sizes");
  VLA_TRY(const Resize size, read_size(fields));
  if (sizes == nullptr) {
    auto first = std::make_unique<FloatFit>();
    if (fields.has("from_width")) {
      CameraSize camera;
      VLA_TRY(camera.width, fields.integer("from_width", kMinSide, kMaxImageSide));
      VLA_TRY(camera.height, fields.integer("from_height", kMinSide, kMaxImageSide));
      first->op.camera = camera;
    }
    sizes = &first->op.sizes;
    recipe.fit = std::move(first);
  }
  sizes->push_back(size);
  recipe.width = size.width;
  recipe.height = size.height;
  return {};
}

/// Crops the centre of the resized image.
Status parse_crop_floats(JsonFields& fields, Recipe& recipe) {
  FloatResizes* const before = recipe.fit != nullptr ? recipe.fit->float_resizes() : nullptr;
  if (before == nullptr || before->crop || !recipe.image.empty())
    return misplaced(fields, "crop_floats once, behind resize_floats");
  CameraSize size;
  VLA_TRY(size.width, fields.integer("width", 1, recipe.width));
  VLA_TRY(size.height, fields.integer("height", 1, recipe.height));
  before->crop = size;
  recipe.width = size.width;
  recipe.height = size.height;
  return {};
}

}  // namespace

Ops resize_floats_ops() {
  return {{"image", "resize_floats", parse_resize_floats}, {"image", "crop_floats", parse_crop_floats}};
}

}  // namespace vla
