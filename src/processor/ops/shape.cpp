// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// Ops that end the state's list, and ops that select the robot's part of a chunk.
#include <fmt/format.h>

#include <utility>

#include "processor/json_fields.h"
#include "processor/ops/columns.h"
#include "processor/recipe.h"

namespace vla {
namespace {

struct PadOp final : StateOp {
  int size = 0, n_row = 1;
  float value = 0.0f;
  Stage stage() const override { return Stage::end; }
  Status bind(StateLayout& layout, const std::string& where) override {
    const std::size_t before = std::exchange(layout.width, static_cast<std::size_t>(size));
    const auto rows = static_cast<std::size_t>(n_row);
    if (before % rows != 0 || layout.width % rows != 0)
      return misfit(where + ".rows", fmt::format("a divisor of {} and {}", before, size), std::to_string(n_row));
    if (layout.width >= before) return {};
    return misfit(where + ".size", fmt::format("at least the {} numbers of the state", before), std::to_string(size));
  }
  Status finish(std::vector<float>& state, std::vector<int>&) const override {
    const auto width = static_cast<std::ptrdiff_t>(state.size()) / n_row;
    const auto n_pad = static_cast<std::size_t>(size / n_row - width);
    for (int row = n_row; row > 0; --row) state.insert(state.begin() + row * width, n_pad, value);
    return {};
  }
};

/// Puts the state into the prompt as integers.
struct BinsOp final : StateOp {
  Bins params;
  Stage stage() const override { return Stage::end; }
  Status bind(StateLayout& layout, const std::string& where) override {
    if (std::exchange(layout.width, 0) == layout.n_state) return {};
    return misfit(where, "bins of the state's own numbers", "them behind sin_cos or rotation");
  }
  Status finish(std::vector<float>& state, std::vector<int>& discretized) const override {
    discretized = bins(params, state);
    state.clear();
    return {};
  }
};

/// Drops the state: the network gets none.
struct DropOp final : StateOp {
  Stage stage() const override { return Stage::end; }
  Status bind(StateLayout& layout, const std::string&) override {
    layout.width = 0;
    return {};
  }
  Status finish(std::vector<float>& state, std::vector<int>&) const override {
    state.clear();
    return {};
  }
};

Status read(JsonFields& fields, PadOp& op) {
  VLA_TRY(op.size, fields.integer("size", 1, kMaxVector));
  if (fields.has("value")) {
    VLA_TRY(op.value, fields.number("value", kPlain));
  }
  if (fields.has("rows")) {
    VLA_TRY(op.n_row, fields.integer("rows", 1, kMaxVector));
  }
  return {};
}

Status read(JsonFields& fields, BinsOp& op) {
  VLA_TRY(op.params.low, fields.wide_number("low", kPlain));
  VLA_TRY(op.params.high, fields.wide_number("high", kPlain));
  VLA_TRY(op.params.count, fields.integer("count", 1, kMaxVector));
  return op.params.low >= op.params.high ? fields.wrong("high", "a number above low") : Status();
}

Status read(JsonFields&, DropOp&) { return {}; }

template <class Op>
Status parse_end(JsonFields& fields, Recipe& recipe) {
  if (!recipe.state.empty() && recipe.state.back()->stage() == StateOp::Stage::end)
    return misplaced(fields, "nothing after pad, bins or drop");
  auto op = std::make_unique<Op>();
  VLA_CHECK(read(fields, *op));
  recipe.discretizes_state = std::is_same_v<Op, BinsOp>;
  recipe.state.push_back(std::move(op));
  return {};
}

/// Keeps the first columns, which are the robot's.
struct TakeOp final : ActionOp {
  int size = 0;
  Status bind(ActionLayout& layout, const std::string& where) override {
    if (size > layout.width)
      return misfit(where + ".size", fmt::format("at most {} columns", layout.width), std::to_string(size));
    layout.width = size;
    return {};
  }
  void apply(std::vector<double>& row, const RowPlace&) const override { row.resize(static_cast<std::size_t>(size)); }
};

Status parse_take(JsonFields& fields, Recipe& recipe) {
  auto op = std::make_unique<TakeOp>();
  VLA_TRY(op->size, fields.integer("size", 1, kMaxVector));
  recipe.action.push_back(std::move(op));
  return {};
}

/// Keeps the rows of a chunk that the robot executes: the first rows, or those after rows of the past.
struct RowsOp final : ActionOp {
  int first = 0, count = 0;
  Status bind(ActionLayout& layout, const std::string& where) override {
    VLA_TRY(const int horizon, layout.bundle.keys().integer("policy.horizon", kAnySize));
    if (first + count > horizon)
      return misfit(where + ".count", fmt::format("at most the {} rows of a chunk (policy.horizon)", horizon),
                    fmt::format("{} from row {} on", count, first));
    layout.first_row = first, layout.n_row = count;
    return {};
  }
  void apply(std::vector<double>&, const RowPlace&) const override {}
};

Status parse_rows(JsonFields& fields, Recipe& recipe) {
  if (!recipe.action.empty()) return misplaced(fields, "rows as the first op");
  auto op = std::make_unique<RowsOp>();
  VLA_TRY(op->count, fields.integer("count", 1, kMaxVector));
  if (fields.has("first")) {
    VLA_TRY(op->first, fields.integer("first", 0, kMaxVector));
  }
  recipe.action.push_back(std::move(op));
  return {};
}

}  // namespace

Ops shape_ops() {
  return {{"state", "pad", parse_end<PadOp>},
          {"state", "bins", parse_end<BinsOp>},
          {"state", "drop", parse_end<DropOp>},
          {"action", "take", parse_take},
          {"action", "rows", parse_rows}};
}

}  // namespace vla
