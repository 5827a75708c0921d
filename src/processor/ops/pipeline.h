// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>
#include <string>
#include <variant>
#include <vector>

#include "base/result.h"
#include "processor/image.h"
#include "processor/ops/op.h"
#include "processor/ops/resize.h"

namespace vla {

/// Pads an image with black on both sides to a square. Of an odd padding, the smaller half is at the left or at the
/// top.
struct SquarePad {};

/// Scales both sides so that the shorter one is `size`, like cv2.resize with INTER_AREA.
struct SmallestSide {
  int size = 0;
};

/// Crops the centre of an image: this fraction of each side, rounded down to whole pixels, at least one pixel.
struct CropFraction {
  double fraction = 0.0;
};

/// Accepts only images of this size, which follows from the aspect of the camera's frames.
struct ExpectSize {
  int width = 0;
  int height = 0;
};

/// Half of a whole number, rounded half to even like Python's round.
constexpr int half_to_even(int whole) { return whole / 2 + (whole % 4 == 3 ? 1 : 0); }

/// Crops the centre of an image that is at least this large. The margin at the left and top is half of what is cut off,
/// rounded half to even.
struct CenterCrop {
  int width = 0;
  int height = 0;
};

/// Resizes by `resample_tensorflow_lanczos3`.
struct Lanczos3 {
  int width = 0;
  int height = 0;
};

/// Crops and resizes by `crop_tensorflow`.
struct CropAndResize {
  double area = 0.0;
  int width = 0;
  int height = 0;
};

/// Encodes and decodes by `codecs::through_jpeg`.
struct JpegRoundTrip {
  int quality = 0;
};

/// Accepts only frames of this size, for one view or for every view.
struct ViewCamera {
  static constexpr int kEvery = -1;

  CameraSize size;
  int view = kEvery;
};

/// Places the image in the upper left corner of a larger image, which is black elsewhere.
struct Canvas {
  int width = 0;
  int height = 0;
};

using ByteOp = std::variant<JpegRoundTrip, SquarePad, SmallestSide, CropFraction, Resize, ExpectSize, ViewCamera,
                            CenterCrop, Lanczos3, CropAndResize, Canvas>;

/// Ops on 8-bit images in order, and the size that the last one must leave.
struct Pipeline {
  int width = 0;
  int height = 0;
  std::vector<ByteOp> ops;
};

/// Writes (3, height, width) float32 to `out`: the resulting bytes, divided by 255. A float frame is copied if no op
/// changes a pixel, and refused otherwise, because the reference receives bytes. A frame whose aspect leads to another
/// size than the network's is refused, too. Source: lerobot policies/groot/processor_groot.py
/// (_transform_n1_7_image_for_vlm_albumentations). Errors: bad_observation.
Status run_pipeline(const Frame& frame, int view, const Pipeline& pipeline, std::span<float> out,
                    const std::string& where);

/// Checks that a frame has the only size that is accepted. Errors: bad_observation.
Status check_camera(const Frame& frame, const CameraSize& camera, const std::string& where);
/// The work of the ops (Fit::work): half a unit for each pixel that an op reads.
std::int64_t pipeline_work(const Pipeline& pipeline, int width, int height);

/// Parses the op "resize" as one of several ops, with a filter on bytes.
Status parse_byte_resize(JsonFields& fields, Recipe& recipe);

}  // namespace vla
