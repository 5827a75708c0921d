// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace vla {

/// Filters of Pillow: a triangle, or Keys' cubic with a = -0.5.
enum class PillowFilter { bilinear, bicubic };

/// An RGB picture of interleaved bytes at another size, by a filter that widens when it shrinks (antialiasing). The
/// result equals Pillow's to the bit: weights are rounded to 22 binary digits, and rows are rounded to bytes before
/// columns are summed. All sizes must be at least 1. Source: Pillow src/libImaging/Resample.c.
std::vector<std::uint8_t> resample_8bit(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                        int to_height, PillowFilter filter = PillowFilter::bilinear);

/// The same by OpenCV's cv::resize with INTER_LINEAR (4.10 and 5.0 agree): no antialiasing, weights of 11 binary
/// digits, and the mean of four pixels where both sides are halved. Source: OpenCV modules/imgproc/src/resize.cpp.
std::vector<std::uint8_t> resample_opencv(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                          int to_height);

/// The same with INTER_AREA, for pictures of three channels: the mean of the part of the picture that an output pixel
/// covers, in integers where both sides shrink by whole numbers and else in float32; where a side grows, two pixels are
/// blended with weights of 11 binary digits. Source: as above.
std::vector<std::uint8_t> resample_opencv_area(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                               int to_height);

/// The same by torchvision's resize of an 8-bit tensor, bicubic with antialiasing: summed in float32, columns first,
/// held in [0, 255] and rounded half to even. Equal to torch 2.13's CPU kernel for AVX2, in whose order numbers are
/// summed; another machine's kernel differs by a rounding of float32 and so, rarely, in a byte.
/// Source: torchvision transforms/_functional_tensor.py resize; torch aten/src/ATen/native/cpu/UpSampleKernel.cpp.
std::vector<std::uint8_t> resample_torch(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                         int to_height);

}  // namespace vla
