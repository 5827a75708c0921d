// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace vla {

/// An RGB picture of interleaved bytes at another size, by a triangle filter that widens when it shrinks
/// (antialiasing). The result equals Pillow's to the bit: weights are rounded to 22 binary digits, and rows are rounded
/// to bytes before columns are summed. All sizes must be at least 1. Source: Pillow src/libImaging/Resample.c, filter
/// BILINEAR.
std::vector<std::uint8_t> resample_8bit(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                        int to_height);

}  // namespace vla
