// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/resize_filters.h"

#include "processor/json_fields.h"
#include "processor/ops/letterbox.h"
#include "processor/resample.h"

namespace vla {
namespace {

const ResizeFilter kFilters[] = {
    {"resize", "opencv_bilinear", resample_opencv},
    {"resize", "torch_bicubic_8bit", resample_torch, true},
    {"resize", "torch_bilinear", stretch},
    {"resize", "pillow_bicubic", resample_pillow_bicubic},
    {"resize", "torch_bicubic_16bit", resample_torch_16bit},
    {"resize", "torch_bilinear_cut", resample_torch_linear},
    {"smallest_side", "opencv_area", resample_opencv_area},
    {"resize_floats", "bicubic", resample_torch_cubic},
    {"resize_floats", "area", resample_torch_area},
    {"resize_floats", "bilinear", resample_torch_bilinear},
};

}  // namespace

const ResizeFilter* find_resize_filter(std::string_view op, std::string_view name) {
  for (const ResizeFilter& filter : kFilters)
    if (filter.op == op && filter.name == name) return &filter;
  return nullptr;
}

Result<const ResizeFilter*> read_resize_filter(JsonFields& fields, std::string_view op) {
  std::vector<const char*> names;
  for (const ResizeFilter& filter : kFilters)
    if (filter.op == op) names.push_back(filter.name);
  VLA_TRY(const int choice, fields.choice("filter", names));
  return find_resize_filter(op, names[static_cast<std::size_t>(choice)]);
}

}  // namespace vla
