// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/normalize.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <numeric>
#include <optional>
#include <tuple>
#include <utility>

#include "processor/json_fields.h"
#include "processor/ops/columns.h"
#include "processor/recipe.h"

namespace vla {
namespace {

using Spread = NormRule::Spread;
using Eps = NormRule::Eps;

using enum NormRule::Arithmetic;

constexpr NormRule kRules[] = {
    {"mean_std", "mean", "std", Spread::value, Eps::divides, float32, false},
    {"min_max", "min", "max", Spread::range, Eps::replaces_zero, float32, false},
    {"quantiles", "q01", "q99", Spread::range, Eps::replaces_zero, float32, false},
    {"quantile10", "q10", "q90", Spread::range, Eps::replaces_zero, float32, false},
    {"openpi_mean_std", "mean", "std", Spread::value, Eps::added, float64, false},
    {"openpi_quantiles", "q01", "q99", Spread::range, Eps::added, float64, false},
    {"openvla_bounds", "min", "max", Spread::range, Eps::added, float64, false},
    {"evo1_mean_std", "mean", "std", Spread::value, Eps::added, float32, false},
    {"evo1_min_max", "min", "max", Spread::range, Eps::added, float32, false},
    {"evo1_quantiles", "q01", "q99", Spread::range, Eps::added, float32, false},
    {"groot_min_max", "min", "max", Spread::range, Eps::zero, numpy, true},
    {"groot_mean_std", "mean", "std", Spread::value, Eps::kept_both_ways, numpy, true},
    {"groot_n1_5_min_max", "min", "max", Spread::range, Eps::zero, float32, true},
    {"groot_n1_5_quantiles", "q01", "q99", Spread::range, Eps::kept, float32, true},
    {"groot_n1_5_mean_std", "mean", "std", Spread::value, Eps::kept, float32, true},
};

/// The spread in the rule's precision.
template <class T>
double spread_of(const NormRule& rule, bool divides, T low, T high, T eps) {
  const T spread = rule.spread == Spread::value ? high : high - low;
  if (rule.eps == Eps::added || (rule.eps == Eps::divides && divides)) return spread + eps;
  return rule.eps == Eps::replaces_zero && spread == 0 ? eps : spread;
}

Result<std::vector<double>> read_statistics(const Bundle& bundle, const std::string& name, std::size_t width,
                                            std::size_t n_row, const std::string& where) {
  VLA_TRY(std::vector<double> values, bundle.stats(name));
  if (values.size() == width || values.size() == n_row * width) return values;
  const std::string rows = n_row > 1 ? fmt::format(", or {} rows of them", n_row) : "";
  return Error{Code::bad_bundle, name, fmt::format("{} numbers{} for {}", width, rows, where),
               std::to_string(values.size())};
}

}  // namespace

std::span<const NormRule> norm_rules() { return kRules; }

const NormRule& norm_rule(std::string_view kind) {
  return *std::find_if(std::begin(kRules), std::end(kRules), [&](const NormRule& rule) { return rule.kind == kind; });
}

Normalizer::Normalizer(const NormRule& rule, Direction direction, double eps, std::vector<double> low,
                       const std::vector<double>& high)
    : rule_(&rule), direction_(direction), low_(std::move(low)) {
  const bool divides = direction == Direction::normalize;
  for (std::size_t i = 0; i < low_.size(); ++i)
    spread_.push_back(rule.arithmetic == float32
                          ? spread_of<float>(rule, divides, static_cast<float>(low_[i]), static_cast<float>(high[i]),
                                             static_cast<float>(eps))
                          : spread_of<double>(rule, divides, low_[i], high[i], eps));
}

namespace {

/// Checks that statistics are plausible: no robot measures values beyond kPlain, and no deviation is negative.
Status check_statistics(const NormRule& rule, std::span<const double> low, std::span<const double> high,
                        const std::string& stats) {
  const bool is_deviation = rule.spread == NormRule::Spread::value;
  for (const auto& [name, values, is_spread] :
       {std::tuple(rule.low, low, false), std::tuple(rule.high, high, is_deviation)})
    for (std::size_t i = 0; i < values.size(); ++i)
      if (values[i] < (is_spread ? 0.0 : kPlain.low) || values[i] > kPlain.high)
        return Error{Code::bad_bundle, fmt::format("{}.{}[{}]", stats, name, i),
                     fmt::format("{} to {}", is_spread ? 0.0 : kPlain.low, kPlain.high), fmt::format("{}", values[i]),
                     "convert the checkpoint again, with the statistics of its training data"};
  return {};
}

}  // namespace

Result<Normalizer> Normalizer::create(const Bundle& bundle, const NormRule& rule, const std::string& stats, double eps,
                                      Direction direction, int width, const std::string& where, int n_row) {
  const auto n_column = static_cast<std::size_t>(width);
  const auto read = [&](const char* statistic) {
    return read_statistics(bundle, fmt::format("{}.{}", stats, statistic), n_column, static_cast<std::size_t>(n_row),
                           where);
  };
  VLA_TRY(std::vector<double> low, read(rule.low));
  VLA_TRY(const std::vector<double> high, read(rule.high));
  if (low.size() != high.size())
    return Error{Code::bad_bundle, fmt::format("{}.{}", stats, rule.high), fmt::format("{} numbers", low.size()),
                 std::to_string(high.size())};
  VLA_CHECK(check_statistics(rule, low, high, stats));
  Normalizer normalizer(rule, direction, eps, std::move(low), high);
  normalizer.row_step_ = high.size() > n_column ? n_column : 0;
  if (direction == Direction::unnormalize) return normalizer;
  for (std::size_t i = 0; i < normalizer.spread_.size(); ++i) {
    const auto divisor = static_cast<float>(normalizer.spread_[i]);
    if ((divisor == 0.0f && rule.has_eps()) || !std::isfinite(divisor))
      return Error{Code::bad_bundle, stats, fmt::format("a spread to divide by in column {}", i),
                   fmt::format("{} with eps {}", divisor, eps)};
  }
  return normalizer;
}

template <class T>
T Normalizer::mapped(T x, std::size_t i) const {
  const T low = static_cast<T>(low_[i]), spread = static_cast<T>(spread_[i]);
  const bool range = rule_->spread == Spread::range;
  if (direction_ == Direction::normalize) return range ? 2 * (x - low) / spread - 1 : (x - low) / spread;
  return range ? (x + 1) / 2 * spread + low : x * spread + low;
}

double Normalizer::mapped_by_numpy(float x, std::size_t i) const {
  if (rule_->spread == Spread::value) return static_cast<float>(mapped<double>(x, i));
  if (direction_ == Direction::normalize) return 2 * static_cast<float>((x - low_[i]) / spread_[i]) - 1;
  return static_cast<double>((x + 1) / 2) * spread_[i] + low_[i];
}

double Normalizer::map(float x, std::size_t column, std::size_t row) const {
  const std::size_t i = row * row_step_ + column;
  const bool normalize = direction_ == Direction::normalize;
  if (spread_[i] == 0 && !rule_->has_eps() && (normalize || rule_->eps == Eps::kept_both_ways))
    return rule_->eps == Eps::zero ? 0.0f : x;
  if (rule_->arithmetic == numpy) return mapped_by_numpy(x, i);
  return rule_->arithmetic == float64 ? static_cast<float>(mapped<double>(x, i)) : mapped<float>(x, i);
}

// --- the ops "normalize" and "unnormalize" --------------------------------------------------------------------------

namespace {

struct Fields {
  const NormRule* rule = nullptr;  // null: identity
  std::string stats;               // prefix of the statistics' tensor names
  double eps = 0.0;
  std::string feature;  // full name of the state feature; empty: the whole vector
  SomeColumns columns;  // columns to normalize; the others pass unchanged

  bool reads(const std::string& tensor) const {
    return rule != nullptr &&
           (tensor == fmt::format("{}.{}", stats, rule->low) || tensor == fmt::format("{}.{}", stats, rule->high));
  }
};

Status read(JsonFields& fields, Fields& op) {
  std::vector<const char*> kinds = {"identity"};
  for (const NormRule& rule : kRules) kinds.push_back(rule.kind);
  VLA_TRY(const int kind, fields.choice("kind", kinds));
  if (kind > 0) op.rule = &kRules[kind - 1];
  if (op.rule != nullptr || fields.has("stats")) {
    VLA_TRY(op.stats, fields.string("stats"));
  }
  if (op.rule != nullptr || fields.has("eps")) {
    VLA_TRY(op.eps, fields.wide_number("eps", {0, 1}));
  }
  if (op.rule != nullptr && !op.rule->has_eps() && op.eps != 0.0)
    return fields.wrong("eps", "0, since these kinds have none");
  if (fields.has("feature")) {
    VLA_TRY(op.feature, fields.string("feature"));
  }
  VLA_TRY(op.columns, read_some_columns(fields));
  return {};
}

class NormalizeOp final : public StateOp {
 public:
  Fields fields;

  Stage stage() const override { return Stage::normalized; }
  Status bind(StateLayout& layout, const std::string& where) override;
  void apply(std::span<float> state) const override {
    for (std::size_t i = 0; i < state.size(); ++i)
      if (normalizes(i)) state[i] = static_cast<float>(normalizer_->map(state[i], i - offset_));
  }
  bool normalizes(std::size_t column) const override { return column < chosen_.size() && chosen_[column]; }
  bool reads(const std::string& tensor) const override { return fields.reads(tensor); }

 private:
  std::optional<Normalizer> normalizer_;  // none for identity
  std::size_t offset_ = 0;                // state column of the first statistic
  std::vector<bool> chosen_;              // for each value whether it is normalized
};

Status NormalizeOp::bind(StateLayout& layout, const std::string& where) {
  std::size_t width = layout.n_state;
  const auto& names = layout.features.names();
  const bool joint = fields.rule != nullptr && fields.rule->joint;
  if (!fields.feature.empty() || (names.size() > 1 && !joint)) {
    const auto index = static_cast<std::size_t>(std::find(names.begin(), names.end(), fields.feature) - names.begin());
    if (index == names.size())
      return misfit(where + ".feature", "one of " + layout.features.listed(), "\"" + fields.feature + "\"");
    const auto before = layout.dims.first(index);
    offset_ = static_cast<std::size_t>(std::accumulate(before.begin(), before.end(), 0));
    width = static_cast<std::size_t>(layout.dims[index]);
  }
  if (fields.rule == nullptr) return {};
  const std::vector<int> columns = chosen_columns(fields.columns, width);
  VLA_CHECK(check_columns(columns, width, where));
  chosen_.resize(layout.n_state);
  for (const int column : columns) chosen_[offset_ + static_cast<std::size_t>(column)] = true;
  VLA_TRY(normalizer_, Normalizer::create(layout.bundle, *fields.rule, fields.stats, fields.eps,
                                          Normalizer::Direction::normalize, static_cast<int>(width), where));
  return {};
}

Status parse_normalize(JsonFields& fields, Recipe& recipe) {
  const auto last = recipe.state.empty() ? StateOp::Stage::convention : recipe.state.back()->stage();
  if (last == StateOp::Stage::end) return misplaced(fields, "nothing after pad, bins or drop");
  if (last >= StateOp::Stage::clipped) return misplaced(fields, "normalize before clip and sin_cos");
  auto op = std::make_unique<NormalizeOp>();
  VLA_CHECK(read(fields, op->fields));
  recipe.state.push_back(std::move(op));
  return {};
}

class UnnormalizeOp final : public ActionOp {
 public:
  Fields fields;

  Status bind(ActionLayout& layout, const std::string& where) override {
    if (fields.rule == nullptr) return {};
    const auto width = static_cast<std::size_t>(layout.width);
    columns_ = chosen_columns(fields.columns, width);
    VLA_CHECK(check_columns(columns_, width, where));
    for (const int column : columns_)
      if (!layout.unnormalized.insert(column).second)
        return misfit(where, "columns that no op before it unnormalizes", fmt::format("column {} again", column));
    VLA_TRY(normalizer_,
            Normalizer::create(layout.bundle, *fields.rule, fields.stats, fields.eps,
                               Normalizer::Direction::unnormalize, layout.width, where, std::max(1, layout.n_row)));
    return {};
  }
  void apply(std::vector<double>& row, const RowPlace& place) const override {
    for (const int column : columns_) {
      const auto i = static_cast<std::size_t>(column);
      row[i] = normalizer_->map(static_cast<float>(row[i]), i, place.index);
    }
  }
  bool unnormalizes(std::size_t column) const override {
    return std::find(columns_.begin(), columns_.end(), static_cast<int>(column)) != columns_.end();
  }
  bool reads(const std::string& tensor) const override { return fields.reads(tensor); }

 private:
  std::optional<Normalizer> normalizer_;  // none for identity
  std::vector<int> columns_;
};

Status parse_unnormalize(JsonFields& fields, Recipe& recipe) {
  auto op = std::make_unique<UnnormalizeOp>();
  VLA_CHECK(read(fields, op->fields));
  if (!op->fields.feature.empty()) return fields.wrong("feature", "no such field here");
  recipe.action.push_back(std::move(op));
  return {};
}

}  // namespace

Ops normalize_ops() { return {{"state", "normalize", parse_normalize}, {"action", "unnormalize", parse_unnormalize}}; }

}  // namespace vla
