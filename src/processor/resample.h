// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace vla {

/// Resizes an RGB image of interleaved bytes, bit-identical to Pillow 13.0: a filter that widens when the image shrinks
/// (antialiasing), a triangle or Keys' cubic with a = -0.5, and integer weights of 22 bits. Rows are rounded to bytes
/// before columns are summed; the other way round if the image loses more than twice as many rows as columns. All sizes
/// must be at least 1. Source: Pillow src/libImaging/Resample.c.
std::vector<std::uint8_t> resample_pillow_bilinear(std::span<const std::uint8_t> rgb, int width, int height,
                                                   int to_width, int to_height);
std::vector<std::uint8_t> resample_pillow_bicubic(std::span<const std::uint8_t> rgb, int width, int height,
                                                  int to_width, int to_height);

/// The same by torchvision's resize of an 8-bit tensor (transforms.v2, torch 2.13): weights have as many bits as fit
/// into 16-bit integers, and rows always come first. Source: torch
/// aten/src/ATen/native/cpu/UpSampleKernelAVXAntialias.h.
std::vector<std::uint8_t> resample_torch_16bit(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                               int to_height);

/// The same by OpenCV's cv::resize with INTER_LINEAR (4.10 and 5.0 agree): no antialiasing, weights of 11 bits, and the
/// mean of four pixels if both sides are halved. Source: OpenCV modules/imgproc/src/resize.cpp.
std::vector<std::uint8_t> resample_opencv(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                          int to_height);

/// The same with INTER_AREA, for images of three channels: the mean of the part of the image that an output pixel
/// covers, in integers if both sides shrink by whole factors, otherwise in float32. If a side grows, two pixels are
/// blended with weights of 11 bits. Source: as for `resample_opencv`.
std::vector<std::uint8_t> resample_opencv_area(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                               int to_height);

/// The same by torchvision's resize of an 8-bit tensor, bicubic with antialiasing: summed in float32, columns first,
/// clamped to [0, 255] and rounded half to even. Sums in the order of torch 2.13's CPU kernel for AVX2 and equals
/// it; kernels of other machines differ by a float32 rounding and so, rarely, in a byte.
/// Source: torchvision transforms/_functional_tensor.py resize; torch aten/src/ATen/native/cpu/UpSampleKernel.cpp.
std::vector<std::uint8_t> resample_torch(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                         int to_height);

/// The same on byte / 255, bilinear with antialiasing in float32; 255 times the result is truncated to bytes.
/// Source: Isaac-GR00T gr00t/data/transform/video.py (VideoToTensor, VideoResize, VideoToNumpy).
std::vector<std::uint8_t> resample_torch_linear(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                                int to_height);

/// Resizes float pixels with the same bicubic filter and antialiasing. Nothing is clamped or rounded, so edges
/// overshoot. Source: torchvision transforms/v2/functional/_geometry.py resize_image, of a float tensor.
std::vector<float> resample_torch_cubic(std::vector<float> rgb, int width, int height, int to_width, int to_height);

/// The same with the bilinear filter.
std::vector<float> resample_torch_bilinear(std::vector<float> rgb, int width, int height, int to_width, int to_height);
/// Resizes float pixels by areas: the mean of all pixels that an output pixel touches, each with the same weight.
/// Source: torch F.interpolate(mode="area"), aten/src/ATen/native/cpu/AdaptiveAvgPoolKernel.cpp.
std::vector<float> resample_torch_area(std::vector<float> rgb, int width, int height, int to_width, int to_height);

/// Resizes bytes like tf.image.resize with lanczos3 and antialiasing (TensorFlow 2.18): rows first, summed in float32,
/// rounded half to even. Sources: tensorflow core/kernels/image/scale_and_translate_op.cc, sampling_kernels.h.
std::vector<std::uint8_t> resample_tensorflow_lanczos3(std::span<const std::uint8_t> rgb, int width, int height,
                                                       int to_width, int to_height);

/// Crops the centre of an image, the share `area` of its area, and resizes it like tf.image.crop_and_resize on byte /
/// 255: the corners of the crop are the corners of the result, pixels are blended without antialiasing, and 255.5 times
/// the result is truncated. Sources: tensorflow core/kernels/image/crop_and_resize_op.cc, image_ops_impl.py
/// (convert_image_dtype); BitVLA experiments/robot/openvla_utils.py (center_crop_image).
std::vector<std::uint8_t> crop_tensorflow(std::span<const std::uint8_t> rgb, int width, int height, double area,
                                          int to_width, int to_height);

}  // namespace vla
