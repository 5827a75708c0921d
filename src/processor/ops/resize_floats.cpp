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
  const std::size_t n_pixel = pixels.size() / 3;
  for (std::size_t i = 0; i < n_pixel; ++i)
    for (std::size_t c = 0; c < 3; ++c) out[c * n_pixel + i] = pixels[3 * i + c];
  return {};
}

namespace {

constexpr int kMinSide = 2;
constexpr std::size_t kMaxSizes = 4;

struct FloatFit final : OneFit<FloatResizes> {
  FloatFit() : OneFit("resized", resize_floats) {}
  std::optional<CameraSize> camera_size(int /*view*/) const override { return op.camera; }
  std::vector<Resize>* float_sizes() override { return &op.sizes; }
};

Result<Resize> read_size(JsonFields& fields) {
  VLA_TRY(const Resize op, read_resize(fields, "resize_floats"));
  if (std::int64_t{op.width} * op.height > ImageLimits().max_pixels)
    return fields.wrong("height", fmt::format("at most {} pixels", ImageLimits().max_pixels));
  return op;
}

/// Several in a row are one fit. The first may name the only frame size that is accepted.
Status parse(JsonFields& fields, Recipe& recipe) {
  std::vector<Resize>* sizes = recipe.fit != nullptr ? recipe.fit->float_sizes() : nullptr;
  if ((recipe.fit != nullptr && sizes == nullptr) || !recipe.image.empty())
    return misplaced(fields, "resize_floats as the first ops on images");
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

}  // namespace

Ops resize_floats_ops() { return {{"image", "resize_floats", parse}}; }

}  // namespace vla
