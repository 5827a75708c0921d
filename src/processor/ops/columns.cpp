// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/columns.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <numeric>

#include "processor/json_fields.h"
#include "processor/ops/planes.h"
#include "processor/recipe.h"

namespace vla {

void map_columns(const ColumnAffine& op, std::span<float> values) {
  for (const int column : op.columns) {
    float& value = values[static_cast<std::size_t>(column)];
    value = static_cast<float>(static_cast<double>(value) * op.scale + op.shift);
  }
}

void map_columns(const HornAngle& op, std::span<float> values) {
  for (const int column : op.columns) {
    float& value = values[static_cast<std::size_t>(column)];
    const double x = static_cast<double>(value) * op.scale + op.shift, r = op.horn_radius, a = op.arm_length;
    const double sine = (r * r + x * x - a * a) / (2.0 * r * x);
    value = static_cast<float>(std::asin(std::clamp(sine, -1.0, 1.0)));
  }
}

void map_columns(const Threshold& op, std::span<float> values) {
  for (const int column : op.columns) {
    float& value = values[static_cast<std::size_t>(column)];
    if (std::isfinite(value)) value = value > op.above ? op.then : op.otherwise;
  }
}

void map_columns(const Sign& op, std::span<float> values) {
  for (const int column : op.columns) {
    float& value = values[static_cast<std::size_t>(column)];
    if (value != 0.0f && !std::isnan(value)) value = std::copysign(1.0f, value);
  }
}

void map_columns(const Sigmoid& op, std::span<float> values) {
  for (const int column : op.columns) {
    float& value = values[static_cast<std::size_t>(column)];
    value = static_cast<float>(1.0 / (1.0 + std::exp(-static_cast<double>(value))));
  }
}

void hold(const Clip& op, std::span<float> values) {
  for (const int column : chosen_columns(op.columns, values.size())) {
    float& value = values[static_cast<std::size_t>(column)];
    if (std::isfinite(value)) value = std::clamp(value, op.low, op.high);
  }
}

std::vector<int> bins(const Bins& op, std::span<const float> values) {
  std::vector<double> edges;
  const double step = (op.high - op.low) / op.count;
  for (int i = 0; i < op.count; ++i) edges.push_back(i * step + op.low);
  std::vector<int> numbers;
  for (const float value : values) {
    const auto above = std::upper_bound(edges.begin(), edges.end(), static_cast<double>(value));
    numbers.push_back(static_cast<int>(above - edges.begin()) - 1);
  }
  return numbers;
}

Status check_columns(const std::vector<int>& columns, std::size_t width, const std::string& where) {
  for (const int column : columns)
    if (static_cast<std::size_t>(column) >= width)
      return misfit(where + ".columns", fmt::format("columns below {}", width), std::to_string(column));
  return {};
}

Result<SomeColumns> read_some_columns(JsonFields& fields) {
  if (!fields.has("columns")) return SomeColumns();
  VLA_TRY(std::vector<int> columns, fields.integers("columns", 0, kMaxVector - 1));
  return SomeColumns(std::move(columns));
}

std::vector<int> chosen_columns(const SomeColumns& columns, std::size_t width) {
  if (columns) return *columns;
  std::vector<int> all(width);
  std::iota(all.begin(), all.end(), 0);
  return all;
}

namespace {

Status read(JsonFields& fields, ColumnAffine& op) {
  VLA_TRY(op.columns, fields.integers("columns", 0, kMaxVector - 1));
  VLA_TRY(op.scale, fields.wide_number("scale", kPlain));
  VLA_TRY(op.shift, fields.wide_number("shift", kPlain));
  return {};
}

Status read(JsonFields& fields, HornAngle& op) {
  VLA_TRY(op.columns, fields.integers("columns", 0, kMaxVector - 1));
  VLA_TRY(op.scale, fields.wide_number("scale", kPlain));
  VLA_TRY(op.shift, fields.wide_number("shift", kPlain));
  VLA_TRY(op.arm_length, fields.wide_number("arm_length", kPlain));
  VLA_TRY(op.horn_radius, fields.wide_number("horn_radius", {1e-9, kPlain.high}));
  return {};
}

Status read(JsonFields& fields, Threshold& op) {
  VLA_TRY(op.columns, fields.integers("columns", 0, kMaxVector - 1));
  VLA_TRY(op.above, fields.number("above", kPlain));
  VLA_TRY(op.then, fields.number("then", kPlain));
  VLA_TRY(op.otherwise, fields.number("else", kPlain));
  return {};
}

Status read(JsonFields& fields, Sign& op) {
  VLA_TRY(op.columns, fields.integers("columns", 0, kMaxVector - 1));
  return {};
}

Status read(JsonFields& fields, Sigmoid& op) {
  VLA_TRY(op.columns, fields.integers("columns", 0, kMaxVector - 1));
  return {};
}

Status read(JsonFields& fields, Clip& op) {
  VLA_TRY(op.low, fields.number("low", kPlain));
  VLA_TRY(op.high, fields.number("high", kPlain));
  VLA_TRY(op.columns, read_some_columns(fields));
  return op.low > op.high ? fields.wrong("high", "a number that is not below low") : Status();
}

StateOp::Stage last_stage(const Recipe& recipe) {
  return recipe.state.empty() ? StateOp::Stage::convention : recipe.state.back()->stage();
}

/// A robot's convention for some columns of its state.
template <class Params>
struct ColumnStateOp final : StateOp {
  Params params;
  Stage stage() const override { return Stage::convention; }
  Status bind(StateLayout& layout, const std::string& where) override {
    return check_columns(params.columns, layout.n_state, where);
  }
  void apply(std::span<float> state) const override { map_columns(params, state); }
};

template <class Params>
Status parse_column_state(JsonFields& fields, Recipe& recipe) {
  if (last_stage(recipe) == StateOp::Stage::end) return misplaced(fields, "nothing after pad, bins or drop");
  if (last_stage(recipe) != StateOp::Stage::convention)
    return misplaced(fields, "the robot's conventions before normalize");
  auto op = std::make_unique<ColumnStateOp<Params>>();
  VLA_CHECK(read(fields, op->params));
  recipe.state.push_back(std::move(op));
  return {};
}

struct ClipStateOp final : StateOp {
  Clip params;
  Stage stage() const override { return Stage::clipped; }
  Status bind(StateLayout& layout, const std::string& where) override {
    return check_columns(chosen_columns(params.columns, layout.n_state), layout.n_state, where);
  }
  void apply(std::span<float> state) const override {
    for (const int column : chosen_columns(params.columns, state.size()))
      clip(state.subspan(static_cast<std::size_t>(column), 1), params.low, params.high);
  }
};

Status parse_state_clip(JsonFields& fields, Recipe& recipe) {
  if (last_stage(recipe) == StateOp::Stage::end) return misplaced(fields, "nothing after pad, bins or drop");
  if (last_stage(recipe) != StateOp::Stage::normalized) return misplaced(fields, "one clip, after normalize");
  auto op = std::make_unique<ClipStateOp>();
  VLA_CHECK(read(fields, op->params));
  recipe.state.push_back(std::move(op));
  return {};
}

template <class Params>
struct ColumnActionOp final : ActionOp {
  Params params;
  Status bind(ActionLayout& layout, const std::string& where) override {
    return check_columns(params.columns, static_cast<std::size_t>(layout.width), where);
  }
  void apply(std::vector<double>& row, const RowPlace&) const override {
    std::vector<float> rounded(row.begin(), row.end());
    map_columns(params, rounded);
    row.assign(rounded.begin(), rounded.end());
  }
};

struct ClipActionOp final : ActionOp {
  Clip params;
  Status bind(ActionLayout& layout, const std::string& where) override {
    const auto width = static_cast<std::size_t>(layout.width);
    return check_columns(chosen_columns(params.columns, width), width, where);
  }
  void apply(std::vector<double>& row, const RowPlace&) const override {
    std::vector<float> rounded(row.begin(), row.end());
    hold(params, rounded);
    row.assign(rounded.begin(), rounded.end());
  }
};

template <class Op>
Status parse_column_action(JsonFields& fields, Recipe& recipe) {
  auto op = std::make_unique<Op>();
  VLA_CHECK(read(fields, op->params));
  recipe.action.push_back(std::move(op));
  return {};
}

/// Adds the state before normalization to these columns. The sum is not rounded.
struct AddStateOp final : ActionOp {
  std::vector<int> columns, state_columns;  // state_columns: `columns` by default
  Status bind(ActionLayout& layout, const std::string& where) override {
    layout.relative = true;
    VLA_CHECK(check_columns(columns, static_cast<std::size_t>(layout.width), where));
    for (const int column : state_columns)
      if (static_cast<std::size_t>(column) >= layout.n_state)
        return misfit(where, fmt::format("columns of the state below {}", layout.n_state), std::to_string(column));
    return {};
  }
  void apply(std::vector<double>& row, const RowPlace& place) const override {
    for (std::size_t i = 0; i < columns.size(); ++i)
      row[static_cast<std::size_t>(columns[i])] += place.raw_state[static_cast<std::size_t>(state_columns[i])];
  }
};

Status parse_add_state(JsonFields& fields, Recipe& recipe) {
  auto op = std::make_unique<AddStateOp>();
  VLA_TRY(op->columns, fields.integers("columns", 0, kMaxVector - 1));
  op->state_columns = op->columns;
  if (fields.has("state_columns")) {
    VLA_TRY(op->state_columns, fields.integers("state_columns", 0, kMaxVector - 1));
  }
  if (op->state_columns.size() != op->columns.size()) return fields.wrong("state_columns", "as many as columns");
  recipe.action.push_back(std::move(op));
  return {};
}

}  // namespace

Ops columns_ops() {
  return {{"state", "affine", parse_column_state<ColumnAffine>},
          {"state", "horn_angle", parse_column_state<HornAngle>},
          {"state", "threshold", parse_column_state<Threshold>},
          {"state", "clip", parse_state_clip},
          {"action", "affine", parse_column_action<ColumnActionOp<ColumnAffine>>},
          {"action", "threshold", parse_column_action<ColumnActionOp<Threshold>>},
          {"action", "sign", parse_column_action<ColumnActionOp<Sign>>},
          {"action", "sigmoid", parse_column_action<ColumnActionOp<Sigmoid>>},
          {"action", "clip", parse_column_action<ClipActionOp>},
          {"action", "add_state", parse_add_state}};
}

}  // namespace vla
