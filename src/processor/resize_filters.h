// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string_view>
#include <variant>
#include <vector>

#include "base/result.h"
#include "processor/image.h"

namespace vla {

class JsonFields;

/// Functions that resize interleaved 8-bit pixels, interleaved floats, or a frame of either kind; the last kind writes
/// planes (3, to_height, to_width).
using ResizeBytes = std::vector<std::uint8_t> (*)(std::span<const std::uint8_t> rgb, int width, int height,
                                                  int to_width, int to_height);
using ResizeFloats = std::vector<float> (*)(std::vector<float> rgb, int width, int height, int to_width, int to_height);
using ResizeToPlanes = void (*)(const Frame& frame, int to_width, int to_height, std::span<float> planes);

/// A value of a recipe's field "filter".
struct ResizeFilter {
  const char* op;    // the op that takes the filter
  const char* name;  // the filter's name in the recipe
  std::variant<ResizeBytes, ResizeFloats, ResizeToPlanes> resize;
  bool cuts_floats = false;  // a filter on bytes that also takes float pixels: it truncates 255 x
};

/// The filter of that name, null if the op has none.
const ResizeFilter* find_resize_filter(std::string_view op, std::string_view name);

/// Reads the field "filter" of an op. Errors: bad_bundle, with the op's filters.
Result<const ResizeFilter*> read_resize_filter(JsonFields& fields, std::string_view op);

}  // namespace vla
