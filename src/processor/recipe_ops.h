// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "processor/json_fields.h"
#include "processor/recipe.h"

/// One function for each list of a recipe: reads one op, the `index`-th of its list, and appends it to the recipe.
/// Errors: bad_bundle, also for an op in a place where it has no meaning.
namespace vla::recipe_ops {

Status parse_image_op(JsonFields& fields, int index, Recipe& recipe);
Status parse_text_op(JsonFields& fields, int index, Recipe& recipe);
Status parse_state_op(JsonFields& fields, int index, Recipe& recipe);
Status parse_action_op(JsonFields& fields, int index, Recipe& recipe);

/// Numbers of pixels, states and actions: far beyond any of them, and far from the end of float32.
inline constexpr Range kPlain = {-1e9, 1e9};

/// The fields of a clip, which pictures and states share.
inline Result<ClipOp> parse_clip(JsonFields& fields) {
  ClipOp op;
  VLA_TRY(op.low, fields.number("low", kPlain));
  VLA_TRY(op.high, fields.number("high", kPlain));
  if (op.low > op.high) return fields.wrong("high", "a number that is not below low");
  return op;
}

inline Error misplaced(const JsonFields& fields, const char* expected) { return fields.wrong("op", expected); }

}  // namespace vla::recipe_ops
