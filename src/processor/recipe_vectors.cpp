// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The ops on states and actions.
#include "processor/recipe_ops.h"

namespace vla::recipe_ops {
namespace {

Result<NormalizeOp> parse_normalize(JsonFields& fields) {
  NormalizeOp op;
  VLA_TRY(const int kind, fields.choice("kind", {"mean_std", "min_max", "quantiles", "quantile10", "identity",
                                                 "openpi_mean_std", "openpi_quantiles", "evo1_mean_std", "evo1_min_max",
                                                 "evo1_quantiles", "groot_min_max", "groot_mean_std"}));
  op.kind = static_cast<NormKind>(kind);
  const bool identity = op.kind == NormKind::identity;
  if (!identity || fields.has("stats")) {
    VLA_TRY(op.stats, fields.string("stats"));
  }
  if (!identity || fields.has("eps")) {
    VLA_TRY(op.eps, fields.wide_number("eps", {0, 1}));
  }
  if (is_groot(op.kind) && op.eps != 0.0) return fields.wrong("eps", "0, since these kinds have none");
  if (fields.has("feature")) {
    VLA_TRY(op.feature, fields.string("feature"));
  }
  return op;
}

Result<ColumnAffineOp> parse_column_affine(JsonFields& fields) {
  ColumnAffineOp op;
  VLA_TRY(op.columns, fields.integers("columns", 0, kMaxVector - 1));
  VLA_TRY(op.scale, fields.wide_number("scale", kPlain));
  VLA_TRY(op.shift, fields.wide_number("shift", kPlain));
  return op;
}

Result<HornAngleOp> parse_horn_angle(JsonFields& fields) {
  HornAngleOp op;
  VLA_TRY(op.columns, fields.integers("columns", 0, kMaxVector - 1));
  VLA_TRY(op.scale, fields.wide_number("scale", kPlain));
  VLA_TRY(op.shift, fields.wide_number("shift", kPlain));
  VLA_TRY(op.arm_length, fields.wide_number("arm_length", kPlain));
  VLA_TRY(op.horn_radius, fields.wide_number("horn_radius", {1e-9, kPlain.high}));
  return op;
}

Result<BinsOp> parse_bins(JsonFields& fields) {
  BinsOp op;
  VLA_TRY(op.low, fields.wide_number("low", kPlain));
  VLA_TRY(op.high, fields.wide_number("high", kPlain));
  VLA_TRY(op.count, fields.integer("count", 1, kMaxVector));
  if (op.low >= op.high) return fields.wrong("high", "a number above low");
  return op;
}

/// Whether the network's own form of the state is reached, so that nothing may follow.
bool ends_state(const StateOp& op) {
  return std::holds_alternative<PadOp>(op) || std::holds_alternative<BinsOp>(op) || std::holds_alternative<DropOp>(op);
}

Result<PadOp> parse_pad(JsonFields& fields) {
  PadOp op;
  VLA_TRY(op.size, fields.integer("size", 1, kMaxVector));
  if (fields.has("value")) {
    VLA_TRY(op.value, fields.number("value", kPlain));
  }
  return op;
}

Result<ThresholdOp> parse_threshold(JsonFields& fields) {
  ThresholdOp op;
  VLA_TRY(op.columns, fields.integers("columns", 0, kMaxVector - 1));
  VLA_TRY(op.above, fields.number("above", kPlain));
  VLA_TRY(op.then, fields.number("then", kPlain));
  VLA_TRY(op.otherwise, fields.number("else", kPlain));
  return op;
}

/// What may follow the ops so far: the robot's conventions, then normalizations, then one clip, then the network's
/// form.
enum Stage { conventions, normalized, clipped, ended };

Stage stage_of(const Recipe& recipe) {
  if (recipe.state.empty()) return conventions;
  if (ends_state(recipe.state.back())) return ended;
  if (std::holds_alternative<ClipOp>(recipe.state.back())) return clipped;
  return std::holds_alternative<NormalizeOp>(recipe.state.back()) ? normalized : conventions;
}

}  // namespace

Status parse_state_op(JsonFields& fields, int, Recipe& recipe) {
  VLA_TRY(const int op, fields.choice("op", {"affine", "horn_angle", "normalize", "clip", "pad", "bins", "drop"}));
  const Stage stage = stage_of(recipe);
  if (stage == ended) return misplaced(fields, "nothing after pad, bins or drop");
  if (op < 2 && stage != conventions) return misplaced(fields, "the robot's conventions before normalize");
  if (op == 2 && stage == clipped) return misplaced(fields, "normalize before clip");
  if (op == 3 && stage != normalized) return misplaced(fields, "one clip, after normalize");
  StateOp state = DropOp{};
  if (op == 0) {
    VLA_TRY(state, parse_column_affine(fields));
  } else if (op == 1) {
    VLA_TRY(state, parse_horn_angle(fields));
  } else if (op == 2) {
    VLA_TRY(state, parse_normalize(fields));
  } else if (op == 3) {
    VLA_TRY(state, parse_clip(fields));
  } else if (op == 4) {
    VLA_TRY(state, parse_pad(fields));
  } else if (op == 5) {
    VLA_TRY(state, parse_bins(fields));
  }
  recipe.state.push_back(std::move(state));
  return {};
}

Status parse_action_op(JsonFields& fields, int index, Recipe& recipe) {
  VLA_TRY(const int op,
          fields.choice("op", {"take", "unnormalize", "add_state", "affine", "threshold", "clip", "rows"}));
  ActionOp action = TakeOp{};
  if (op == 0) {
    VLA_TRY(const int size, fields.integer("size", 1, kMaxVector));
    action = TakeOp{size};
  } else if (op == 1) {
    VLA_TRY(NormalizeOp unnormalize, parse_normalize(fields));
    if (!unnormalize.feature.empty()) return fields.wrong("feature", "no such field here");
    action = std::move(unnormalize);
  } else if (op == 2) {
    AddStateOp add;
    VLA_TRY(add.columns, fields.integers("columns", 0, kMaxVector - 1));
    action = std::move(add);
  } else if (op == 3) {
    VLA_TRY(action, parse_column_affine(fields));
  } else if (op == 4) {
    VLA_TRY(action, parse_threshold(fields));
  } else if (op == 5) {
    VLA_TRY(action, parse_clip(fields));
  } else {
    if (index != 0) return misplaced(fields, "rows as the first op");
    VLA_TRY(const int count, fields.integer("count", 1, kMaxVector));
    action = RowsOp{count};
  }
  recipe.action.push_back(std::move(action));
  return {};
}

}  // namespace vla::recipe_ops
