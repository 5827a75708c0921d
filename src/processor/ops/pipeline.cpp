// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/pipeline.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "processor/byte_pixels.h"
#include "processor/image_codecs.h"
#include "processor/json_fields.h"
#include "processor/recipe.h"
#include "processor/resample.h"

namespace vla {
namespace {

/// Sides in double precision, in which the reference scales them. Scaling a very narrow image may exceed an integer's
/// range.
struct Size {
  double width, height;
  bool operator==(const Size&) const = default;
};

struct Image {
  int width, height;
  std::vector<std::uint8_t> rgb;
};

Size size_after(const SquarePad&, const Size& from) {
  const double side = std::max(from.width, from.height);
  return {side, side};
}

Size size_after(const SmallestSide& op, const Size& from) {
  const double scale = op.size / std::min(from.width, from.height);
  return {std::max(1.0, std::nearbyint(from.width * scale)), std::max(1.0, std::nearbyint(from.height * scale))};
}

Size size_after(const CropFraction& op, const Size& from) {
  return {std::max(1.0, std::floor(from.width * op.fraction)), std::max(1.0, std::floor(from.height * op.fraction))};
}

Size size_after(const JpegRoundTrip&, const Size& from) { return from; }
Size size_after(const ViewCamera&, const Size& from) { return from; }

/// The size that an op states.
template <class Op>
Size size_after(const Op& op, const Size&) {
  return {static_cast<double>(op.width), static_cast<double>(op.height)};
}

Image cropped(const Image& from, const CenterCrop& op) {
  Image to{op.width, op.height, {}};
  const int left = half_to_even(from.width - op.width), top = half_to_even(from.height - op.height);
  for (int y = 0; y < op.height; ++y) {
    const auto start = from.rgb.begin() + 3 * (static_cast<std::ptrdiff_t>(top + y) * from.width + left);
    to.rgb.insert(to.rgb.end(), start, start + 3 * static_cast<std::ptrdiff_t>(op.width));
  }
  return to;
}

/// Centres the image in another size: crops what does not fit and fills the rest with black.
Image centred(const Image& from, int width, int height) {
  Image to{width, height, std::vector<std::uint8_t>(static_cast<std::size_t>(width) * height * 3)};
  const int left = (width - from.width) / 2, top = (height - from.height) / 2;
  const int n_column = std::min(width, from.width), n_row = std::min(height, from.height);
  for (int y = 0; y < n_row; ++y) {
    const std::size_t in_row = static_cast<std::size_t>(y + std::max(0, (from.height - height) / 2)) * from.width;
    const std::size_t out_row = static_cast<std::size_t>(y + std::max(0, top)) * width;
    const auto start = static_cast<std::ptrdiff_t>(3 * (in_row + std::max(0, (from.width - width) / 2)));
    std::copy_n(from.rgb.begin() + start, 3 * n_column,
                to.rgb.begin() + static_cast<std::ptrdiff_t>(3 * (out_row + std::max(0, left))));
  }
  return to;
}

/// Copies rows of pixels to the start of wider rows; the rest is zero.
template <class T>
std::vector<T> on_canvas(std::span<const T> rgb, int width, const Canvas& canvas) {
  std::vector<T> out(static_cast<std::size_t>(canvas.width) * static_cast<std::size_t>(canvas.height) * 3);
  const std::size_t from = 3 * static_cast<std::size_t>(width), to = 3 * static_cast<std::size_t>(canvas.width);
  for (std::size_t y = 0; y < rgb.size() / from; ++y)
    std::copy_n(rgb.begin() + static_cast<std::ptrdiff_t>(y * from), from,
                out.begin() + static_cast<std::ptrdiff_t>(y * to));
  return out;
}

/// Whether the size of the op's result follows from the frame and not from the recipe.
bool follows_frame(const ByteOp& op) {
  return std::holds_alternative<SquarePad>(op) || std::holds_alternative<SmallestSide>(op);
}

/// The maximum number of pixels after such ops, so that the size of the admitted frame limits the cost of an act: four
/// times the frame's pixels, enough for an aspect of 4 to 1, and more for small frames.
double most_pixels_grown(const Frame& frame) { return std::max(4.0 * frame.width * frame.height, 1024.0 * 1024.0); }

Image applied(const ByteOp& op, const Image& from, int width, int height) {
  if (const auto* jpeg = std::get_if<JpegRoundTrip>(&op))
    return {width, height, codecs::through_jpeg(from.rgb, width, height, jpeg->quality)};
  if (std::holds_alternative<SmallestSide>(op))
    return {width, height, resample_opencv_area(from.rgb, from.width, from.height, width, height)};
  if (const auto* resize = std::get_if<Resize>(&op))
    return {width, height,
            std::get<ResizeBytes>(resize->filter->resize)(from.rgb, from.width, from.height, width, height)};
  if (std::holds_alternative<ExpectSize>(op)) return from;
  if (std::holds_alternative<ViewCamera>(op)) return from;
  if (const auto* canvas = std::get_if<Canvas>(&op))
    return {width, height, on_canvas<std::uint8_t>(from.rgb, from.width, *canvas)};
  if (const auto* crop = std::get_if<CenterCrop>(&op)) return cropped(from, *crop);
  if (const auto* crop = std::get_if<CropAndResize>(&op))
    return {width, height, crop_tensorflow(from.rgb, from.width, from.height, crop->area, width, height)};
  if (std::holds_alternative<Lanczos3>(op))
    return {width, height, resample_tensorflow_lanczos3(from.rgb, from.width, from.height, width, height)};
  return centred(from, width, height);
}

/// Whether no op changes a pixel, so that frames of the stated size are used as they are.
bool keeps_pixels(const Pipeline& pipeline) {
  return !pipeline.ops.empty() && std::all_of(pipeline.ops.begin(), pipeline.ops.end(), [](const ByteOp& op) {
    return std::holds_alternative<ViewCamera>(op) || std::holds_alternative<ExpectSize>(op) ||
           std::holds_alternative<Canvas>(op);
  });
}

/// Spreads float pixels over planes, on the canvas if there is one.
void spread_floats(const std::vector<float>& rgb, int width, const Pipeline& pipeline, std::span<float> out) {
  const auto as_is = [](float value) { return value; };
  for (const ByteOp& op : pipeline.ops)
    if (const auto* canvas = std::get_if<Canvas>(&op))
      return spread(std::span<const float>(on_canvas<float>(rgb, width, *canvas)), out, as_is);
  spread(std::span(rgb), out, as_is);
}

/// The camera of a view, or nullptr if its frames may have any size.
const ViewCamera* camera_of(const Pipeline& pipeline, int view) {
  for (const ByteOp& op : pipeline.ops)
    if (const auto* camera = std::get_if<ViewCamera>(&op);
        camera != nullptr && (camera->view == ViewCamera::kEvery || camera->view == view))
      return camera;
  return nullptr;
}

}  // namespace

Status run_pipeline(const Frame& frame, int view, const Pipeline& pipeline, std::span<float> out,
                    const std::string& where) {
  const auto* floats = std::get_if<std::vector<float>>(&frame.rgb);
  if (floats != nullptr && !keeps_pixels(pipeline))
    return Error{Code::bad_observation, where, "pixels of 8 bits", "float pixels",
                 "send the camera's bytes: this policy's images are cut and resized as bytes"};
  if (const ViewCamera* camera = camera_of(pipeline, view)) VLA_CHECK(check_camera(frame, camera->size, where));
  // Computes all sizes before any image, so that no image is made that is refused later or does not fit into memory.
  const double most_grown = most_pixels_grown(frame);
  std::vector<Size> sizes = {{static_cast<double>(frame.width), static_cast<double>(frame.height)}};
  bool fits = true;
  const auto another_aspect = [&](int width, int height) {
    return Error{Code::bad_observation, where, fmt::format("an image with the aspect of {} x {}", width, height),
                 fmt::format("{} x {}, which becomes {} x {}", frame.width, frame.height, sizes.back().width,
                             sizes.back().height),
                 "this policy's images keep their aspect; send those of the camera that the bundle was made for"};
  };
  for (const ByteOp& op : pipeline.ops) {
    if (const auto* size = std::get_if<ExpectSize>(&op); size && sizes.back() != size_after(*size, {}))
      return another_aspect(size->width, size->height);
    if (const auto* crop = std::get_if<CenterCrop>(&op))
      fits &= crop->width <= sizes.back().width && crop->height <= sizes.back().height;
    if (const auto* canvas = std::get_if<Canvas>(&op))
      fits &= canvas->width >= sizes.back().width && canvas->height >= sizes.back().height;
    sizes.push_back(std::visit([&](const auto& o) { return size_after(o, sizes.back()); }, op));
    const double n_pixel = sizes.back().width * sizes.back().height;
    if (follows_frame(op) && n_pixel > most_grown)
      return Error{Code::bad_observation, where,
                   fmt::format("an image that padding and scaling make no larger than {} pixels", most_grown),
                   fmt::format("{} x {}, which becomes {} x {}", frame.width, frame.height, sizes.back().width,
                               sizes.back().height),
                   "send whole camera images, whose sides are more alike"};
    fits &= n_pixel <= static_cast<double>(ImageLimits().max_pixels);
  }
  if (!fits || sizes.back() != Size{static_cast<double>(pipeline.width), static_cast<double>(pipeline.height)})
    return another_aspect(pipeline.width, pipeline.height);
  if (floats != nullptr) {
    spread_floats(*floats, frame.width, pipeline, out);
    return {};
  }
  Image image{frame.width, frame.height, std::get<std::vector<std::uint8_t>>(frame.rgb)};
  for (std::size_t i = 0; i < pipeline.ops.size(); ++i)
    image =
        applied(pipeline.ops[i], image, static_cast<int>(sizes[i + 1].width), static_cast<int>(sizes[i + 1].height));
  spread_bytes(image.rgb, out);
  return {};
}

Status check_camera(const Frame& frame, const CameraSize& camera, const std::string& where) {
  if (frame.width == camera.width && frame.height == camera.height) return {};
  return Error{Code::bad_observation, where, fmt::format("an image of {} x {}", camera.width, camera.height),
               fmt::format("{} x {}", frame.width, frame.height),
               "this policy takes the images of the cameras that it was trained with"};
}

std::int64_t pipeline_work(const Pipeline& pipeline, int width, int height) {
  constexpr double kMost = 1e15;  // limit for images that are extremely narrow
  constexpr double kJpeg = 4.0;   // encoding and decoding
  Size size = {static_cast<double>(width), static_cast<double>(height)};
  double n_read = 0.0;
  for (const ByteOp& op : pipeline.ops) {
    n_read += size.width * size.height * (std::holds_alternative<JpegRoundTrip>(op) ? kJpeg : 1.0);
    size = std::visit([&](const auto& o) { return size_after(o, size); }, op);
  }
  return static_cast<std::int64_t>(std::min(n_read / 2, kMost));
}

namespace {

constexpr std::size_t kMaxByteOps = kMaxViews + 16;

struct PipelineFit final : Fit {
  const char* described() const override { return "padded, scaled and cropped as the recipe says"; }
  Status apply(const Frame& frame, int view, std::span<float> planes, const std::string& where) const override {
    return run_pipeline(frame, view, op, planes, where);
  }
  std::optional<CameraSize> camera_size(int view) const override {
    const ViewCamera* camera = camera_of(op, view);
    return camera != nullptr ? std::optional(camera->size) : std::nullopt;
  }
  int n_view() const override {
    int n = 0;
    for (const ByteOp& each : op.ops)
      if (const auto* camera = std::get_if<ViewCamera>(&each)) n = std::max(n, camera->view + 1);
    return n;
  }
  std::int64_t work(int width, int height) const override { return pipeline_work(op, width, height); }

  Pipeline op;
};

/// The pipeline that the next op belongs to.
Result<Pipeline*> open_pipeline(const JsonFields& fields, Recipe& recipe) {
  if (recipe.width > 0) return misplaced(fields, "images of any size before size, letterbox or resize");
  if (recipe.fit == nullptr) recipe.fit = std::make_unique<PipelineFit>();
  return &static_cast<PipelineFit&>(*recipe.fit).op;  // every other fit has set recipe.width
}

Status add(const JsonFields& fields, Recipe& recipe, ByteOp op) {
  VLA_TRY(Pipeline* const pipeline, open_pipeline(fields, recipe));
  if (pipeline->ops.size() == kMaxByteOps) return misplaced(fields, "fewer ops on images of any size");
  pipeline->ops.push_back(op);
  return {};
}

Status parse_jpeg(JsonFields& fields, Recipe& recipe) {
  JpegRoundTrip op;
  VLA_TRY(op.quality, fields.integer("quality", 1, 100));
  return add(fields, recipe, op);
}

Status parse_square_pad(JsonFields& fields, Recipe& recipe) { return add(fields, recipe, SquarePad{}); }

Status parse_smallest_side(JsonFields& fields, Recipe& recipe) {
  SmallestSide op;
  VLA_TRY(op.size, fields.integer("size", 1, kMaxImageSide));
  VLA_CHECK(read_resize_filter(fields, "smallest_side"));
  return add(fields, recipe, op);
}

Status parse_crop_fraction(JsonFields& fields, Recipe& recipe) {
  CropFraction op;
  VLA_TRY(op.fraction, fields.wide_number("fraction", {1e-6, 1}));
  return add(fields, recipe, op);
}

Status parse_crop_and_resize(JsonFields& fields, Recipe& recipe) {
  CropAndResize op;
  VLA_TRY(op.area, fields.wide_number("area", {1e-6, 1}));
  VLA_TRY(op.width, fields.integer("width", 1, kMaxImageSide));
  VLA_TRY(op.height, fields.integer("height", 1, kMaxImageSide));
  return add(fields, recipe, op);
}

Status parse_camera_size(JsonFields& fields, Recipe& recipe) {
  ViewCamera op;
  VLA_TRY(op.size.width, fields.integer("width", 1, kMaxImageSide));
  VLA_TRY(op.size.height, fields.integer("height", 1, kMaxImageSide));
  if (fields.has("view")) {
    VLA_TRY(op.view, fields.integer("view", 0, kMaxViews - 1));
  }
  return add(fields, recipe, op);
}

template <class Op>
Status parse_stated_size(JsonFields& fields, Recipe& recipe) {
  Op op;
  VLA_TRY(op.width, fields.integer("width", 1, kMaxImageSide));
  VLA_TRY(op.height, fields.integer("height", 1, kMaxImageSide));
  return add(fields, recipe, op);
}

/// Whether images keep the aspect of the frame, and frames may have any aspect.
bool has_any_aspect(const Pipeline& pipeline) {
  bool any = false;
  for (const ByteOp& op : pipeline.ops) {
    if (std::holds_alternative<SquarePad>(op) || std::holds_alternative<ViewCamera>(op)) return false;
    any = (any || std::holds_alternative<SmallestSide>(op)) && !std::holds_alternative<ExpectSize>(op);
  }
  return any;
}

/// The end of a pipeline: the size that the images must have.
Status parse_size(JsonFields& fields, Recipe& recipe) {
  VLA_TRY(Pipeline* const pipeline, open_pipeline(fields, recipe));
  VLA_TRY(recipe.width, fields.integer("width", 1, kMaxImageSide));
  VLA_TRY(recipe.height, fields.integer("height", 1, kMaxImageSide));
  pipeline->width = recipe.width;
  pipeline->height = recipe.height;
  return {};
}

}  // namespace

Status parse_byte_resize(JsonFields& fields, Recipe& recipe) {
  VLA_TRY(Pipeline* const pipeline, open_pipeline(fields, recipe));
  if (has_any_aspect(*pipeline))
    return misplaced(fields,
                     "images of one aspect: a smallest_side keeps that of every frame, which resize would squeeze");
  VLA_TRY(const Resize op, read_resize(fields, "resize"));
  if (!std::holds_alternative<ResizeBytes>(op.filter->resize)) return fields.wrong("filter", "a filter on bytes");
  return add(fields, recipe, op);
}

Ops pipeline_ops() {
  return {{"image", "jpeg", parse_jpeg},
          {"image", "square_pad", parse_square_pad},
          {"image", "smallest_side", parse_smallest_side},
          {"image", "crop_fraction", parse_crop_fraction},
          {"image", "crop_and_resize", parse_crop_and_resize},
          {"image", "lanczos3", parse_stated_size<Lanczos3>},
          {"image", "expect_size", parse_stated_size<ExpectSize>},
          {"image", "camera_size", parse_camera_size},
          {"image", "canvas", parse_stated_size<Canvas>},
          {"image", "center_crop", parse_stated_size<CenterCrop>},
          {"image", "size", parse_size}};
}

}  // namespace vla
