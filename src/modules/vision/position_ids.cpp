// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/position_ids.h"

#include <fmt/format.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <numeric>

namespace vla {
namespace {

/// torch.arange(1/n, 1, 1/n) in float32. torch computes vectors of `width` elements: each starts at a rounded multiple
/// and continues in double; vectors come in pairs, and the remainder is computed one by one. The last bits therefore
/// depend on the machine's width: 8 with AVX2 and AVX-512, 4 with NEON, 1 without vectors.
std::vector<float> boundaries(int n_table, int width) {
  const double step = 1.0 / n_table;
  const int count = static_cast<int>(std::ceil((1.0 - step) / step));
  std::vector<float> edges;
  int i = 0;
  for (; width > 1 && i + 2 * width <= count; i += 2 * width)
    for (int k = 0; k < 2 * width; ++k) {
      const float base = static_cast<float>(step + (i + k / width * width) * step);
      edges.push_back(static_cast<float>(double{base} + k % width * step));
    }
  for (; i < count; ++i) edges.push_back(static_cast<float>(step + i * step));
  return edges;
}

float round_to_bfloat16(float x) {
  const std::uint32_t bits = std::bit_cast<std::uint32_t>(x);
  return std::bit_cast<float>((bits + 0x7fff + ((bits >> 16) & 1)) & 0xffff0000u);
}

/// The position of patch i of n as a fraction of the image, in the rule's arithmetic.
float fraction(const std::string& rule, int i, int n) {
  if (rule == "bucketize_shifted")
    return static_cast<float>(i) / static_cast<float>(n) * static_cast<float>(1.0 - 1e-6);
  const float exact = std::min(static_cast<float>(i) * (1.0f / static_cast<float>(n)), static_cast<float>(1.0 - 1e-6));
  return rule == "bucketize_bfloat16" ? round_to_bfloat16(exact) : exact;
}

/// torch.bucketize(right=True): the number of boundaries that are at most the fraction.
std::vector<std::int32_t> axis_ids(const std::string& rule, int n_grid, const std::vector<float>& edges) {
  std::vector<std::int32_t> ids;
  for (int i = 0; i < n_grid; ++i)
    ids.push_back(static_cast<std::int32_t>(std::upper_bound(edges.begin(), edges.end(), fraction(rule, i, n_grid)) -
                                            edges.begin()));
  return ids;
}

Result<std::vector<std::int32_t>> row_major_ids(int n_grid, int n_table) {
  if (n_grid != n_table)
    return Error{Code::unsupported, "vision.position_rule", fmt::format("{0} x {0} patches, as the table has", n_table),
                 fmt::format("{0} x {0}", n_grid), "row_major is defined for images of vision.image_size only"};
  std::vector<std::int32_t> ids(static_cast<std::size_t>(n_grid) * static_cast<std::size_t>(n_grid));
  std::iota(ids.begin(), ids.end(), 0);
  return ids;
}

}  // namespace

Result<std::vector<std::int32_t>> vision_position_ids(const std::string& rule, int n_grid, int n_table) {
  if (rule == "row_major") return row_major_ids(n_grid, n_table);
  if (rule != "bucketize_float32" && rule != "bucketize_bfloat16" && rule != "bucketize_shifted")
    return Error{Code::bad_bundle, "vision.position_rule",
                 "bucketize_float32, bucketize_bfloat16, bucketize_shifted or row_major", rule};
  const std::vector<std::int32_t> axis = axis_ids(rule, n_grid, boundaries(n_table, 1));
  for (int width : {4, 8, 16})
    if (axis_ids(rule, n_grid, boundaries(n_table, width)) != axis)
      return Error{Code::unsupported, "vision.position_rule", "a grid whose position ids are the same on every machine",
                   fmt::format("{} x {} patches on a table of {} x {}", n_grid, n_grid, n_table, n_table),
                   "the reference's own result depends on the machine here; use another image size"};
  if (axis.back() >= n_table)  // torch would stop with an IndexError
    return Error{Code::unsupported, "vision.position_rule", fmt::format("position ids below {}", n_table),
                 std::to_string(axis.back()), "the reference fails on this grid too; use another image size"};
  std::vector<std::int32_t> ids;
  for (std::int32_t row : axis)
    for (std::int32_t column : axis) ids.push_back(row * n_table + column);
  return ids;
}

}  // namespace vla
