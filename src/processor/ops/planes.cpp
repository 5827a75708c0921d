// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/planes.h"

#include <algorithm>

#include "base/bf16.h"
#include "processor/json_fields.h"
#include "processor/recipe.h"

namespace vla {
namespace {

float rounded(float x) { return from_bf16(to_bf16(x)); }

void standardize_in_bf16(std::span<float> plane, float mean, float divisor) {
  for (float& x : plane) x = rounded(rounded(rounded(x) - mean) / divisor);
}

}  // namespace

void standardize(std::span<float> pixels, const Standardize& op) {
  const std::size_t size = pixels.size() / op.mean.size();
  for (std::size_t c = 0; c < op.mean.size(); ++c) standardize(pixels.subspan(c * size, size), c, op);
}

void standardize(std::span<float> plane, std::size_t channel, const Standardize& op) {
  if (op.arithmetic == Standardize::Arithmetic::bfloat16)
    return standardize_in_bf16(plane, rounded(op.mean[channel]), rounded(op.std[channel]));
  const float unit = op.arithmetic == Standardize::Arithmetic::float32_in_bytes ? 255.0f : 1.0f;
  const float mean = unit * op.mean[channel], divisor = unit * op.std[channel];
  for (float& x : plane) x = (unit * x - mean) / divisor;
  if (op.arithmetic == Standardize::Arithmetic::float32_then_bfloat16)
    for (float& x : plane) x = rounded(x);
}

void affine(std::span<float> values, float scale, float shift) {
  for (float& value : values) {
    const float scaled = value * scale;
    value = scaled + shift;
  }
}

void clip(std::span<float> values, float low, float high) {
  for (float& value : values) value = std::clamp(value, low, high);
}

namespace {

struct AffineOp final : PlaneOp {
  float scale = 1.0f, shift = 0.0f;
  void apply(std::span<float> values, std::size_t) const override { affine(values, scale, shift); }
};

struct ClipOp final : PlaneOp {
  float low = 0.0f, high = 0.0f;
  void apply(std::span<float> values, std::size_t) const override { clip(values, low, high); }
};

struct StandardizeOp final : PlaneOp {
  Standardize by;
  int of_view = kEveryView;
  int view() const override { return of_view; }
  void apply(std::span<float> values, std::size_t channel) const override { standardize(values, channel, by); }
};

Status read(JsonFields& fields, AffineOp& op) {
  VLA_TRY(op.scale, fields.number("scale", kPlain));
  VLA_TRY(op.shift, fields.number("shift", kPlain));
  return {};
}

Status read(JsonFields& fields, ClipOp& op) {
  VLA_TRY(op.low, fields.number("low", kPlain));
  VLA_TRY(op.high, fields.number("high", kPlain));
  return op.low > op.high ? fields.wrong("high", "a number that is not below low") : Status();
}

Status read(JsonFields& fields, StandardizeOp& op) {
  VLA_TRY(const std::vector<float> mean, fields.numbers("mean", op.by.mean.size(), kPlain));
  VLA_TRY(const std::vector<float> std, fields.numbers("std", op.by.std.size(), {1e-6, kPlain.high}));
  VLA_TRY(const int arithmetic,
          fields.choice("arithmetic", {"float32", "bfloat16", "float32_then_bfloat16", "float32_in_bytes"}));
  op.by.arithmetic = static_cast<Standardize::Arithmetic>(arithmetic);
  std::copy(mean.begin(), mean.end(), op.by.mean.begin());
  std::copy(std.begin(), std.end(), op.by.std.begin());
  if (fields.has("view")) {
    VLA_TRY(op.of_view, fields.integer("view", 0, kMaxViews - 1));
  }
  return {};
}

template <class Op>
Status parse_plane(JsonFields& fields, Recipe& recipe) {
  if (recipe.width == 0) return misplaced(fields, "a letterbox or a resize first, or ops that end in size");
  auto op = std::make_unique<Op>();
  VLA_CHECK(read(fields, *op));
  recipe.image.push_back(std::move(op));
  return {};
}

}  // namespace

Ops planes_ops() {
  return {{"image", "affine", parse_plane<AffineOp>},
          {"image", "clip", parse_plane<ClipOp>},
          {"image", "standardize", parse_plane<StandardizeOp>}};
}

}  // namespace vla
