// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// Encodes angles without a jump at the end of a turn.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <iterator>

#include "processor/json_fields.h"
#include "processor/ops/columns.h"
#include "processor/recipe.h"

namespace vla {
namespace {

/// Replaces each feature whose columns are in `columns` by the sines of these columns, followed by their cosines.
/// Source: Isaac-GR00T gr00t/data/utils.py (apply_sin_cos_encoding).
struct SinCosOp final : StateOp {
  std::vector<int> columns;

  Stage stage() const override { return Stage::widened; }
  Status bind(StateLayout& layout, const std::string& where) override {
    VLA_CHECK(check_columns(columns, layout.n_state, where));
    std::size_t first = 0, n_named = 0;
    for (const int dim : layout.dims) {
      const auto width = static_cast<std::size_t>(dim);
      std::size_t n = 0;
      for (const int column : columns) n += static_cast<std::size_t>(column) - first < width ? 1 : 0;
      if (n != 0 && n != width)
        return misfit(where + ".columns", fmt::format("all {} columns of a feature from column {}", width, first),
                      fmt::format("{} of them", n));
      spans_.push_back({width, n != 0});
      if (n != 0) layout.n_unmoved = std::min(layout.n_unmoved, first);
      first += width;
      n_named += n;
    }
    layout.width += n_named;
    return {};
  }
  Status finish(std::vector<float>& state, std::vector<int>&) const override {
    std::vector<float> wide;
    auto from = state.begin();
    for (const Span& span : spans_) {
      const auto to = from + static_cast<std::ptrdiff_t>(span.width);
      if (span.turns) {
        std::transform(from, to, std::back_inserter(wide), [](double x) { return static_cast<float>(std::sin(x)); });
        std::transform(from, to, std::back_inserter(wide), [](double x) { return static_cast<float>(std::cos(x)); });
      } else {
        wide.insert(wide.end(), from, to);
      }
      from = to;
    }
    state.swap(wide);
    return {};
  }

 private:
  struct Span {
    std::size_t width;
    bool turns;
  };
  std::vector<Span> spans_;  // one per feature
};

Status parse_sin_cos(JsonFields& fields, Recipe& recipe) {
  const auto last = recipe.state.empty() ? StateOp::Stage::convention : recipe.state.back()->stage();
  if (last >= StateOp::Stage::widened) return misplaced(fields, "one sin_cos, before pad");
  auto op = std::make_unique<SinCosOp>();
  VLA_TRY(op->columns, fields.integers("columns", 0, kMaxVector - 1));
  recipe.state.push_back(std::move(op));
  return {};
}

}  // namespace

Ops sin_cos_ops() { return {{"state", "sin_cos", parse_sin_cos}}; }

}  // namespace vla
