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

/// Black on both sides of an image that is not square, until it is; of an odd rest less at the left and at the top.
struct SquarePad {};

/// Both sides scaled so that the shorter one is `size`, as cv2.resize does with INTER_AREA.
struct SmallestSide {
  int size = 0;
};

/// The middle of an image: this fraction of each side, cut to whole pixels, but one pixel at least.
struct CropFraction {
  double fraction = 0.0;
};

/// Images of one size alone, which follows from the aspect of the camera's frames.
struct ExpectSize {
  int width = 0;
  int height = 0;
};

/// Half of a whole number, as Python rounds it.
constexpr int half_to_even(int whole) { return whole / 2 + (whole % 4 == 3 ? 1 : 0); }

/// The middle of an image, no larger than it; of an odd rest that is cut off the half is rounded to even.
struct CenterCrop {
  int width = 0;
  int height = 0;
};

/// The same by `resample_tensorflow_lanczos3`.
struct Lanczos3 {
  int width = 0;
  int height = 0;
};

/// `crop_tensorflow`.
struct CropAndResize {
  double area = 0.0;
  int width = 0;
  int height = 0;
};

/// `codecs::through_jpeg`.
struct JpegRoundTrip {
  int quality = 0;
};

/// Frames of one view's camera alone, or of every view's.
struct ViewCamera {
  static constexpr int kEvery = -1;

  CameraSize size;
  int view = kEvery;
};

/// The image in the upper left corner of a larger one, which is black beyond it.
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

/// Writes (3, height, width) float32 to `out`: the resulting bytes, divided by 255. A frame of floats comes as it is
/// where no op changes a pixel, and is refused otherwise, since the reference gets bytes; so is one whose aspect leads
/// to another size than the network takes. Source: lerobot policies/groot/processor_groot.py
/// (_transform_n1_7_image_for_vlm_albumentations). Errors: bad_observation.
Status run_pipeline(const Frame& frame, int view, const Pipeline& pipeline, std::span<float> out,
                    const std::string& where);

/// Checks that a frame is of the camera whose frames alone are taken. Errors: bad_observation.
Status check_camera(const Frame& frame, const CameraSize& camera, const std::string& where);
/// Half a pixel for each that an op reads.
std::int64_t pipeline_work(const Pipeline& pipeline, int width, int height);

/// The op "resize" among others, by a filter on bytes.
Status parse_byte_resize(JsonFields& fields, Recipe& recipe);

}  // namespace vla
