// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The ops on what a robot sees and is told.
#include <fmt/format.h>

#include <algorithm>

#include "processor/recipe_ops.h"
#include "processor/text.h"

namespace vla::recipe_ops {
namespace {

Result<Letterbox> parse_letterbox(JsonFields& fields) {
  Letterbox op;
  VLA_TRY(op.width, fields.integer("width", 1, kMaxImageSide));
  VLA_TRY(op.height, fields.integer("height", 1, kMaxImageSide));
  VLA_CHECK(fields.choice("filter", {"bilinear"}));
  VLA_TRY(op.antialias, fields.boolean("antialias"));
  VLA_TRY(const int align, fields.choice("align", {"bottom_right", "center"}));
  op.align = static_cast<Letterbox::Align>(align);
  VLA_TRY(op.fill, fields.number("fill", {0, 1}));
  return op;
}

Result<Resize> parse_resize(JsonFields& fields) {
  constexpr int kMinSide = 2;  // torch reads the wrong rows for a picture of one column
  Resize op;
  VLA_TRY(op.width, fields.integer("width", kMinSide, kMaxImageSide));
  VLA_TRY(op.height, fields.integer("height", kMinSide, kMaxImageSide));
  VLA_TRY(const int filter, fields.choice("filter", {"opencv_bilinear", "torch_bicubic_8bit"}));
  op.filter = static_cast<Resize::Filter>(filter);
  return op;
}

Result<AffineOp> parse_affine(JsonFields& fields) {
  AffineOp op;
  VLA_TRY(op.scale, fields.number("scale", kPlain));
  VLA_TRY(op.shift, fields.number("shift", kPlain));
  return op;
}

Result<Standardize> parse_standardize(JsonFields& fields) {
  Standardize op;
  VLA_TRY(const std::vector<float> mean, fields.numbers("mean", op.mean.size(), kPlain));
  VLA_TRY(const std::vector<float> std, fields.numbers("std", op.std.size(), {1e-6, kPlain.high}));
  VLA_TRY(const int arithmetic,
          fields.choice("arithmetic", {"float32", "bfloat16", "float32_then_bfloat16", "float32_in_bytes"}));
  op.arithmetic = static_cast<Standardize::Arithmetic>(arithmetic);
  std::copy(mean.begin(), mean.end(), op.mean.begin());
  std::copy(std.begin(), std.end(), op.std.begin());
  return op;
}

template <class Op>
Result<PictureOp> parse_stated_size(JsonFields& fields) {
  Op op;
  VLA_TRY(op.width, fields.integer("width", 1, kMaxImageSide));
  VLA_TRY(op.height, fields.integer("height", 1, kMaxImageSide));
  return PictureOp(op);
}

Result<PictureOp> parse_picture_op(JsonFields& fields, int op) {
  if (op == 0) {
    ByteResize resize;
    VLA_TRY(resize.width, fields.integer("width", 1, kMaxImageSide));
    VLA_TRY(resize.height, fields.integer("height", 1, kMaxImageSide));
    VLA_TRY(const int filter, fields.choice("filter", {"pillow_bicubic", "torch_bicubic_16bit", "torch_bilinear_cut"}));
    resize.filter = static_cast<ByteResize::Filter>(filter);
    return PictureOp(resize);
  }
  if (op == 1) return PictureOp(SquarePad{});
  if (op == 2) {
    SmallestSide smallest;
    VLA_TRY(smallest.size, fields.integer("size", 1, kMaxImageSide));
    VLA_CHECK(fields.choice("filter", {"opencv_area"}));
    return PictureOp(smallest);
  }
  if (op == 4) return parse_stated_size<CameraSize>(fields);
  if (op == 5) return parse_stated_size<CenterCrop>(fields);
  CropFraction crop;
  VLA_TRY(crop.fraction, fields.wide_number("fraction", {1e-6, 1}));
  return PictureOp(crop);
}

/// The end of a pipeline: the size that the pictures must have.
Status parse_size(JsonFields& fields, Pipeline& pipeline, Recipe& recipe) {
  VLA_TRY(pipeline.width, fields.integer("width", 1, kMaxImageSide));
  VLA_TRY(pipeline.height, fields.integer("height", 1, kMaxImageSide));
  recipe.width = pipeline.width;
  recipe.height = pipeline.height;
  return {};
}

template <class Op>
Status set_fit(Result<Op> op, Recipe& recipe) {
  if (!op) return op.error();
  recipe.fit = *op;
  recipe.width = op->width;
  recipe.height = op->height;
  return {};
}

/// `op`: of the ops that make planes of one size, which letterbox and a resize in first place do alone and a pipeline
/// in several.
Status parse_fit(JsonFields& fields, int op, bool first, Recipe& recipe) {
  constexpr int kResize = 1, kSize = 7;
  if (op == 0 && !first) return misplaced(fields, "a letterbox as the first and only op on pictures");
  if (op == 0) return set_fit(parse_letterbox(fields), recipe);
  if (op == kResize && first) return set_fit(parse_resize(fields), recipe);
  if (recipe.width > 0) return misplaced(fields, "pictures of any size before size, letterbox or resize");
  if (first) recipe.fit = Pipeline{};
  auto& pipeline = std::get<Pipeline>(recipe.fit);
  if (op == kSize) return parse_size(fields, pipeline, recipe);
  if (pipeline.ops.size() == kMaxPictureOps) return misplaced(fields, "fewer ops on pictures");
  VLA_TRY(PictureOp picture, parse_picture_op(fields, op - kResize));
  pipeline.ops.push_back(picture);
  return {};
}

Status parse_tokenize(JsonFields& fields, Recipe& recipe) {
  VLA_TRY(recipe.max_tokens, fields.integer("max_tokens", 1, kMaxVector));
  VLA_TRY(const int truncate, fields.choice("truncate", {"right", "left"}));
  recipe.keep_last = truncate == 1;
  return {};
}

Result<std::string> parse_text(JsonFields& fields, const char* name) {
  VLA_TRY(std::string text, fields.string(name));
  if (text.size() <= kMaxOpText) return text;
  return fields.wrong(name, fmt::format("at most {} bytes of text", kMaxOpText));
}

Result<TextOp> parse_template(JsonFields& fields) {
  TemplateOp op;
  VLA_TRY(op.text, parse_text(fields, "text"));
  if (!is_template(op.text))
    return fields.wrong("text", "text with {instruction} once, {state} once at most and no other braces");
  return TextOp(std::move(op));
}

Result<TextOp> parse_replace(JsonFields& fields) {
  ReplaceOp op;
  VLA_TRY(op.from, parse_text(fields, "from"));
  VLA_TRY(op.to, parse_text(fields, "to"));
  if (op.from.empty()) return fields.wrong("from", "text to look for");
  return TextOp(std::move(op));
}

Result<TextOp> parse_ensure_suffix(JsonFields& fields) {
  EnsureSuffixOp op;
  VLA_TRY(op.suffix, parse_text(fields, "suffix"));
  return TextOp(std::move(op));
}

Result<TextOp> parse_views(JsonFields& fields) {
  ViewsOp op;
  VLA_TRY(op.count, fields.integer("count", 1, kMaxViews));
  VLA_TRY(op.open, fields.string("open"));
  VLA_TRY(op.token, fields.string("token"));
  VLA_TRY(op.repeat, fields.integer("repeat", 1, kMaxVector));
  VLA_TRY(op.close, fields.string("close"));
  if (fields.has("place")) {
    VLA_TRY(const int place, fields.choice("place", {"front", "back"}));
    op.behind = place == 1;
  }
  if (op.token.empty()) return fields.wrong("token", "the text of a token");
  if (!is_numbered(op.open)) return fields.wrong("open", "text with {i} once at most and no other braces");
  const std::size_t longest = kMaxViewsText / static_cast<std::size_t>(op.count);
  if (op.open.size() > longest || op.close.size() > longest ||
      op.token.size() > longest / static_cast<std::size_t>(op.repeat))
    return fields.wrong("repeat", "less than a mebibyte of text");
  return TextOp(std::move(op));
}

}  // namespace

Status parse_image_op(JsonFields& fields, int index, Recipe& recipe) {
  VLA_TRY(const int op, fields.choice("op", {"letterbox", "resize", "square_pad", "smallest_side", "crop_fraction",
                                             "camera_size", "center_crop", "size", "affine", "clip", "standardize"}));
  constexpr int kFits = 8;
  if (op < kFits) return parse_fit(fields, op, index == 0, recipe);
  if (recipe.width == 0) return misplaced(fields, "a letterbox or a resize first, or ops that end in size");
  ImageOp image;
  if (op == kFits) {
    VLA_TRY(image, parse_affine(fields));
  } else if (op == kFits + 1) {
    VLA_TRY(image, parse_clip(fields));
  } else {
    VLA_TRY(image, parse_standardize(fields));
  }
  recipe.image.push_back(image);
  return {};
}

namespace {

bool has_views(const Recipe& recipe) {
  return std::any_of(recipe.text.begin(), recipe.text.end(),
                     [](const TextOp& op) { return std::holds_alternative<ViewsOp>(op); });
}

}  // namespace

Status parse_text_op(JsonFields& fields, int, Recipe& recipe) {
  VLA_TRY(const int op, fields.choice("op", {"strip", "replace", "ensure_suffix", "template", "views", "tokenize",
                                             "lower", "drop_punctuation"}));
  if (recipe.max_tokens > 0) return misplaced(fields, "nothing after tokenize");
  if (op == 5) return parse_tokenize(fields, recipe);
  const bool framed = has_views(recipe);
  if (framed && (op != 3 || !std::holds_alternative<ViewsOp>(recipe.text.back())))
    return misplaced(fields, "tokenize after views, or one template and tokenize");
  TextOp text = StripOp{};
  if (op == 1) {
    VLA_TRY(text, parse_replace(fields));
  } else if (op == 2) {
    VLA_TRY(text, parse_ensure_suffix(fields));
  } else if (op == 3) {
    VLA_TRY(text, parse_template(fields));
  } else if (op == 4) {
    VLA_TRY(text, parse_views(fields));
  } else if (op == 6) {
    text = LowerOp{};
  } else if (op == 7) {
    text = DropPunctuationOp{};
  }
  recipe.text.push_back(std::move(text));
  return {};
}

}  // namespace vla::recipe_ops
