// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/normalize.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <numeric>
#include <optional>
#include <utility>

#include "processor/ops/columns.h"
#include "processor/recipe.h"

namespace vla {
namespace {

using Spread = NormRule::Spread;
using Eps = NormRule::Eps;

constexpr NormRule kRules[] = {
    {"mean_std", "mean", "std", Spread::value, Eps::divides, false, false},
    {"min_max", "min", "max", Spread::range, Eps::replaces_zero, false, false},
    {"quantiles", "q01", "q99", Spread::range, Eps::replaces_zero, false, false},
    {"quantile10", "q10", "q90", Spread::range, Eps::replaces_zero, false, false},
    {"openpi_mean_std", "mean", "std", Spread::value, Eps::added, true, false},
    {"openpi_quantiles", "q01", "q99", Spread::range, Eps::added, true, false},
    {"evo1_mean_std", "mean", "std", Spread::value, Eps::added, false, false},
    {"evo1_min_max", "min", "max", Spread::range, Eps::added, false, false},
    {"evo1_quantiles", "q01", "q99", Spread::range, Eps::added, false, false},
    {"groot_min_max", "min", "max", Spread::range, Eps::none, false, true},
    {"groot_mean_std", "mean", "std", Spread::value, Eps::none, true, true},
};

/// The spread in the precision of the rule.
template <class T>
double spread_of(const NormRule& rule, bool divides, T low, T high, T eps) {
  const T spread = rule.spread == Spread::value ? high : high - low;
  if (rule.eps == Eps::added || (rule.eps == Eps::divides && divides)) return spread + eps;
  return rule.eps == Eps::replaces_zero && spread == 0 ? eps : spread;
}

Result<std::vector<double>> read_statistics(const Bundle& bundle, const std::string& name, int width,
                                            const std::string& where) {
  VLA_TRY(std::vector<double> values, bundle.stats(name));
  if (values.size() == static_cast<std::size_t>(width)) return values;
  return Error{Code::bad_bundle, name, fmt::format("{} numbers for {}", width, where), std::to_string(values.size())};
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
    spread_.push_back(rule.wide ? spread_of<double>(rule, divides, low_[i], high[i], eps)
                                : spread_of<float>(rule, divides, static_cast<float>(low_[i]),
                                                   static_cast<float>(high[i]), static_cast<float>(eps)));
}

Result<Normalizer> Normalizer::create(const Bundle& bundle, const NormRule& rule, const std::string& stats, double eps,
                                      Direction direction, int width, const std::string& where) {
  VLA_TRY(std::vector<double> low, read_statistics(bundle, fmt::format("{}.{}", stats, rule.low), width, where));
  VLA_TRY(const std::vector<double> high,
          read_statistics(bundle, fmt::format("{}.{}", stats, rule.high), width, where));
  Normalizer normalizer(rule, direction, eps, std::move(low), high);
  if (direction == Direction::unnormalize) return normalizer;
  for (std::size_t i = 0; i < normalizer.spread_.size(); ++i) {
    const auto divisor = static_cast<float>(normalizer.spread_[i]);
    if ((divisor == 0.0f && rule.eps != Eps::none) || !std::isfinite(divisor))
      return Error{Code::bad_bundle, stats, fmt::format("a spread to divide by in column {}", i),
                   fmt::format("{} with eps {}", divisor, eps)};
  }
  return normalizer;
}

template <class T>
T Normalizer::mapped(T x, std::size_t column) const {
  const T low = static_cast<T>(low_[column]), spread = static_cast<T>(spread_[column]);
  const bool range = rule_->spread == Spread::range, normalize = direction_ == Direction::normalize;
  if (spread == 0 && rule_->eps == Eps::none && (normalize || !range)) return range ? T{0} : x;
  if (normalize) return range ? 2 * (x - low) / spread - 1 : (x - low) / spread;
  return range ? (x + 1) / 2 * spread + low : x * spread + low;
}

void Normalizer::apply(std::span<float> values) const {
  for (std::size_t i = 0; i < values.size(); ++i)
    values[i] = rule_->wide ? static_cast<float>(mapped<double>(values[i], i)) : mapped<float>(values[i], i);
}

// --- the ops "normalize" and "unnormalize" --------------------------------------------------------------------------

namespace {

struct Fields {
  const NormRule* rule = nullptr;  // null: identity
  std::string stats;               // prefix of the statistics' tensor names
  double eps = 0.0;
  std::string feature;  // full name of the state feature that it works on; empty: the whole vector

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
  if (op.rule != nullptr && op.rule->eps == Eps::none && op.eps != 0.0)
    return fields.wrong("eps", "0, since these kinds have none");
  if (fields.has("feature")) {
    VLA_TRY(op.feature, fields.string("feature"));
  }
  return {};
}

class NormalizeOp final : public StateOp {
 public:
  Fields fields;

  Stage stage() const override { return Stage::normalized; }
  Status bind(const StateLayout& layout, const std::string& where) override;
  void apply(std::span<float> state) const override {
    for (const Normalizer& normalizer : normalizer_) normalizer.apply(state.subspan(offset_, width_));
  }
  std::span<const float> normalized(std::span<const float> state) const override {
    return normalizer_.empty() ? std::span<const float>() : state.subspan(offset_, width_);
  }
  bool reads(const std::string& tensor) const override { return fields.reads(tensor); }

 private:
  std::vector<Normalizer> normalizer_;  // none for identity
  std::size_t offset_ = 0, width_ = 0;  // of the columns that it works on
};

Status NormalizeOp::bind(const StateLayout& layout, const std::string& where) {
  width_ = layout.n_state;
  const auto& names = layout.features.names();
  const bool joint = fields.rule != nullptr && fields.rule->joint;
  if (!fields.feature.empty() || (names.size() > 1 && !joint)) {
    const auto index = static_cast<std::size_t>(std::find(names.begin(), names.end(), fields.feature) - names.begin());
    if (index == names.size())
      return misfit(where + ".feature", "one of " + layout.features.listed(), "\"" + fields.feature + "\"");
    const auto before = layout.dims.first(index);
    offset_ = static_cast<std::size_t>(std::accumulate(before.begin(), before.end(), 0));
    width_ = static_cast<std::size_t>(layout.dims[index]);
  }
  if (fields.rule == nullptr) return {};
  VLA_TRY(Normalizer normalizer, Normalizer::create(layout.bundle, *fields.rule, fields.stats, fields.eps,
                                                    Normalizer::Direction::normalize, static_cast<int>(width_), where));
  normalizer_.push_back(std::move(normalizer));
  return {};
}

Status parse_normalize(JsonFields& fields, Recipe& recipe) {
  const auto last = recipe.state.empty() ? StateOp::Stage::convention : recipe.state.back()->stage();
  if (last == StateOp::Stage::end) return misplaced(fields, "nothing after pad, bins or drop");
  if (last == StateOp::Stage::clipped) return misplaced(fields, "normalize before clip");
  auto op = std::make_unique<NormalizeOp>();
  VLA_CHECK(read(fields, op->fields));
  recipe.state.push_back(std::move(op));
  return {};
}

class UnnormalizeOp final : public ActionOp {
 public:
  Fields fields;
  std::optional<std::vector<int>> columns;  // the others pass

  Status bind(ActionLayout& layout, const std::string& where) override {
    if (fields.rule == nullptr) return {};
    if (columns) VLA_CHECK(check_columns(*columns, static_cast<std::size_t>(layout.width), where));
    VLA_TRY(Normalizer normalizer, Normalizer::create(layout.bundle, *fields.rule, fields.stats, fields.eps,
                                                      Normalizer::Direction::unnormalize, layout.width, where));
    normalizer_.push_back(std::move(normalizer));
    return {};
  }
  void apply(std::vector<float>& row, std::span<const float>) const override {
    std::vector<float> mapped = row;
    for (const Normalizer& normalizer : normalizer_) normalizer.apply(mapped);
    if (!columns) return row.swap(mapped);
    for (const int column : *columns) row[static_cast<std::size_t>(column)] = mapped[static_cast<std::size_t>(column)];
  }
  bool reads(const std::string& tensor) const override { return fields.reads(tensor); }

 private:
  std::vector<Normalizer> normalizer_;  // none for identity
};

Status parse_unnormalize(JsonFields& fields, Recipe& recipe) {
  auto op = std::make_unique<UnnormalizeOp>();
  VLA_CHECK(read(fields, op->fields));
  if (!op->fields.feature.empty()) return fields.wrong("feature", "no such field here");
  if (fields.has("columns")) {
    VLA_TRY(op->columns, fields.integers("columns", 0, kMaxVector - 1));
  }
  recipe.action.push_back(std::move(op));
  return {};
}

}  // namespace

Ops normalize_ops() { return {{"state", "normalize", parse_normalize}, {"action", "unnormalize", parse_unnormalize}}; }

}  // namespace vla
