// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/resize_floats.h"

#include <fmt/format.h>

#include "processor/byte_pixels.h"
#include "processor/json_fields.h"
#include "processor/ops/pipeline.h"
#include "processor/recipe.h"
#include "processor/resample.h"

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
  for (const FloatResize& size : to.sizes) {
    if (size.width == width && size.height == height) continue;
    pixels = size.filter == FloatResize::Filter::area
                 ? resample_torch_area(pixels, width, height, size.width, size.height)
                 : resample_torch_cubic(std::move(pixels), width, height, size.width, size.height);
    width = size.width;
    height = size.height;
  }
  const std::size_t n_pixel = pixels.size() / 3;
  for (std::size_t i = 0; i < n_pixel; ++i)
    for (std::size_t c = 0; c < 3; ++c) out[c * n_pixel + i] = pixels[3 * i + c];
  return {};
}

namespace {

constexpr int kMinSide = 2;  // torch reads the wrong rows of an image with one column
constexpr std::size_t kMaxSizes = 4;

struct FloatFit final : OneFit<FloatResizes> {
  FloatFit() : OneFit("resized", resize_floats) {}
  std::optional<CameraSize> camera_size() const override { return op.camera; }
};

Result<FloatResize> read_size(JsonFields& fields) {
  FloatResize op;
  VLA_TRY(op.width, fields.integer("width", kMinSide, kMaxImageSide));
  VLA_TRY(op.height, fields.integer("height", kMinSide, kMaxImageSide));
  VLA_TRY(const int filter, fields.choice("filter", {"bicubic", "area"}));
  op.filter = static_cast<FloatResize::Filter>(filter);
  if (std::int64_t{op.width} * op.height > ImageLimits().max_pixels)
    return fields.wrong("height", fmt::format("at most {} pixels", ImageLimits().max_pixels));
  return op;
}

/// Several in a row are one fit. The first may name the only frame size that is accepted.
Status parse(JsonFields& fields, Recipe& recipe) {
  auto* fit = dynamic_cast<FloatFit*>(recipe.fit.get());
  if ((recipe.fit != nullptr && fit == nullptr) || !recipe.image.empty())
    return misplaced(fields, "resize_floats as the first ops on images");
  if (fit != nullptr && fit->op.sizes.size() == kMaxSizes) return misplaced(fields, "fewer sizes");
  VLA_TRY(const FloatResize size, read_size(fields));
  if (fit == nullptr) {
    auto first = std::make_unique<FloatFit>();
    fit = first.get();
    recipe.fit = std::move(first);
    if (fields.has("from_width")) {
      CameraSize camera;
      VLA_TRY(camera.width, fields.integer("from_width", kMinSide, kMaxImageSide));
      VLA_TRY(camera.height, fields.integer("from_height", kMinSide, kMaxImageSide));
      fit->op.camera = camera;
    }
  }
  fit->op.sizes.push_back(size);
  recipe.width = size.width;
  recipe.height = size.height;
  return {};
}

}  // namespace

Ops resize_floats_ops() { return {{"image", "resize_floats", parse}}; }

}  // namespace vla
