// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/image.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>

#include "base/npy.h"
#include "processor/image_codecs.h"

namespace vla {
namespace codecs {

Error refused(const std::string& where, std::string expected, std::string found, std::string hint) {
  return {Code::bad_observation, where, std::move(expected), std::move(found), std::move(hint)};
}

constexpr std::int64_t kMaxSide = 1 << 14;

Status check_size(std::int64_t width, std::int64_t height, const std::string& where, const ImageLimits& limits) {
  const std::string found = fmt::format("{} x {}", width, height);
  if (width < 1 || height < 1) return refused(where, "an image with at least one pixel", found);
  // Divides, because the product of two hostile sizes may overflow.
  if (width > limits.max_pixels / height)
    return Error{limits.over, where, fmt::format("at most {} pixels", limits.max_pixels), found,
                 "scale the image down"};
  // Each row has a fixed cost, however short it is, and padding turns a single line into a square.
  if (std::max(width, height) > kMaxSide)
    return Error{limits.over, where, fmt::format("sides of at most {} pixels", kMaxSide), found,
                 "scale the image down"};
  return {};
}

Result<ImageHeader> read_header(Bytes file, const std::string& where, const ImageLimits& limits) {
  if (is_png(file)) return png_header(file, where, limits);
  if (is_jpeg(file)) return jpeg_header(file, where, limits);
  return refused(where, "a PNG or JPEG image", "a file of another kind");
}

std::optional<std::string> suspicious(const Frame& frame) {
  constexpr std::uint8_t kOne = 1;
  const auto is_flat = [](const auto& rgb) { return std::equal(rgb.begin() + 3, rgb.end(), rgb.begin()); };
  if (frame.width * frame.height > 1 && std::visit(is_flat, frame.rgb))
    return "all pixels are alike: is the camera on?";
  const auto* bytes = std::get_if<std::vector<std::uint8_t>>(&frame.rgb);
  if (bytes != nullptr && std::all_of(bytes->begin(), bytes->end(), [](std::uint8_t byte) { return byte <= kOne; }))
    return "all bytes are 0 or 1: were pixels in [0, 1] made whole numbers? multiply them by 255 first";
  return {};
}

}  // namespace codecs

namespace {

Status check_floats(std::span<const float> values, const std::string& where) {
  for (const float value : values)
    if (!(value >= 0.0f && value <= 1.0f))
      return codecs::refused(where, "float pixels in [0, 1]", fmt::format("{}", value), "divide 8-bit values by 255");
  return {};
}

Result<Frame> decode_pixels(codecs::Bytes file, const std::string& where, const ImageLimits& limits) {
  VLA_TRY(codecs::Image image,
          codecs::is_png(file) ? codecs::decode_png(file, where, limits) : codecs::decode_jpeg(file, where, limits));
  return Frame{image.width, image.height, std::move(image.rgb), codecs::orientation(image.exif, image.xmp)};
}

Result<Frame> decode_npy(codecs::Bytes file, const std::string& where, const ImageLimits& limits) {
  VLA_TRY(NpyArray array, parse_npy(file, where));
  if (array.shape.size() != 3 || array.shape[2] != 3)
    return codecs::refused(where, "an array (height, width, 3)",
                           fmt::format("shape ({})", fmt::join(array.shape, ", ")));
  const auto height = static_cast<std::int64_t>(array.shape[0]), width = static_cast<std::int64_t>(array.shape[1]);
  VLA_CHECK(codecs::check_size(width, height, where, limits));
  Frame frame{static_cast<int>(width), static_cast<int>(height), std::move(array.values)};
  VLA_CHECK(check_frame(frame, where, limits));
  return frame;
}

}  // namespace

Status check_frame(const Frame& frame, const std::string& where, const ImageLimits& limits) {
  VLA_CHECK(codecs::check_size(frame.width, frame.height, where, limits));
  const auto expected = static_cast<std::size_t>(frame.width) * static_cast<std::size_t>(frame.height) * 3;
  const std::size_t found = std::visit([](const auto& values) { return values.size(); }, frame.rgb);
  if (found != expected)
    return codecs::refused(where, fmt::format("{} numbers for {} x {} RGB", expected, frame.width, frame.height),
                           std::to_string(found));
  if (const auto* floats = std::get_if<std::vector<float>>(&frame.rgb)) return check_floats(*floats, where);
  return {};
}

Result<Frame> decode_image(std::span<const std::byte> file, const std::string& where, const ImageLimits& limits) {
  constexpr const char* kFormats = "a PNG, JPEG or .npy image";
  if (file.empty()) return codecs::refused(where, kFormats, "an empty file");
  if (codecs::is_png(file) || codecs::is_jpeg(file)) return decode_pixels(file, where, limits);
  if (is_npy(file)) return decode_npy(file, where, limits);
  return codecs::refused(where, kFormats, "a file of another kind");
}

}  // namespace vla
