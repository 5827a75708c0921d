// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/recipe.h"

#include <functional>
#include <map>

#include "processor/json_fields.h"
#include "processor/text.h"

namespace vla {
namespace {

constexpr const char* kWhere = "processor.recipe";

Error misplaced(const JsonFields& fields, const char* expected) { return fields.wrong("op", expected); }

Status parse_letterbox(JsonFields& fields, Letterbox& op) {
  VLA_TRY(op.width, fields.integer("width", 1, kMaxImageSide));
  VLA_TRY(op.height, fields.integer("height", 1, kMaxImageSide));
  VLA_CHECK(fields.choice("filter", {"bilinear"}));
  VLA_TRY(op.antialias, fields.boolean("antialias"));
  VLA_TRY(const int align, fields.choice("align", {"bottom_right", "center"}));
  op.align = static_cast<Letterbox::Align>(align);
  VLA_TRY(op.fill, fields.number("fill"));
  return {};
}

Status parse_image_op(JsonFields& fields, int index, Recipe& recipe) {
  VLA_TRY(const int op, fields.choice("op", {"letterbox", "affine", "clip"}));
  if (op == 0)
    return index == 0 ? parse_letterbox(fields, recipe.letterbox) : misplaced(fields, "one letterbox, first");
  if (index == 0) return misplaced(fields, "a letterbox first");
  if (op == 1) {
    AffineOp affine;
    VLA_TRY(affine.scale, fields.number("scale"));
    VLA_TRY(affine.shift, fields.number("shift"));
    recipe.image.push_back(affine);
    return {};
  }
  ClipOp clip;
  VLA_TRY(clip.low, fields.number("low"));
  VLA_TRY(clip.high, fields.number("high"));
  if (clip.low > clip.high) return fields.wrong("high", "a number that is not below low");
  recipe.image.push_back(clip);
  return {};
}

Status parse_tokenize(JsonFields& fields, Recipe& recipe) {
  VLA_TRY(recipe.max_tokens, fields.integer("max_tokens", 1, kMaxVector));
  VLA_TRY(const int truncate, fields.choice("truncate", {"right", "left"}));
  recipe.keep_last = truncate == 1;
  return {};
}

Result<TextOp> parse_template(JsonFields& fields) {
  TemplateOp op;
  VLA_TRY(op.text, fields.string("text"));
  if (!is_template(op.text))
    return fields.wrong("text", "text with {instruction} once, {state} once at most and no other braces");
  return TextOp(std::move(op));
}

Result<TextOp> parse_replace(JsonFields& fields) {
  ReplaceOp op;
  VLA_TRY(op.from, fields.string("from"));
  VLA_TRY(op.to, fields.string("to"));
  if (op.from.empty()) return fields.wrong("from", "text to look for");
  return TextOp(std::move(op));
}

Result<TextOp> parse_ensure_suffix(JsonFields& fields) {
  EnsureSuffixOp op;
  VLA_TRY(op.suffix, fields.string("suffix"));
  return TextOp(std::move(op));
}

Status parse_text_op(JsonFields& fields, int, Recipe& recipe) {
  VLA_TRY(const int op, fields.choice("op", {"strip", "replace", "ensure_suffix", "template", "tokenize"}));
  if (recipe.max_tokens > 0) return misplaced(fields, "nothing after tokenize");
  if (op == 4) return parse_tokenize(fields, recipe);
  TextOp text = StripOp{};
  if (op == 1) {
    VLA_TRY(text, parse_replace(fields));
  } else if (op == 2) {
    VLA_TRY(text, parse_ensure_suffix(fields));
  } else if (op == 3) {
    VLA_TRY(text, parse_template(fields));
  }
  recipe.text.push_back(std::move(text));
  return {};
}

Result<NormalizeOp> parse_normalize(JsonFields& fields) {
  NormalizeOp op;
  VLA_TRY(const int kind, fields.choice("kind", {"mean_std", "min_max", "quantiles", "quantile10", "identity",
                                                 "openpi_mean_std", "openpi_quantiles"}));
  op.kind = static_cast<NormKind>(kind);
  const bool identity = op.kind == NormKind::identity;
  if (!identity || fields.has("stats")) {
    VLA_TRY(op.stats, fields.string("stats"));
  }
  if (!identity || fields.has("eps")) {
    VLA_TRY(op.eps, fields.wide_number("eps"));
  }
  if (op.eps < 0.0) return fields.wrong("eps", "a number that is not negative");
  if (fields.has("feature")) {
    VLA_TRY(op.feature, fields.string("feature"));
  }
  return op;
}

Result<ColumnAffineOp> parse_column_affine(JsonFields& fields) {
  ColumnAffineOp op;
  VLA_TRY(op.columns, fields.integers("columns", 0, kMaxVector - 1));
  VLA_TRY(op.scale, fields.wide_number("scale"));
  VLA_TRY(op.shift, fields.wide_number("shift"));
  return op;
}

Result<HornAngleOp> parse_horn_angle(JsonFields& fields) {
  HornAngleOp op;
  VLA_TRY(op.columns, fields.integers("columns", 0, kMaxVector - 1));
  VLA_TRY(op.scale, fields.wide_number("scale"));
  VLA_TRY(op.shift, fields.wide_number("shift"));
  VLA_TRY(op.arm_length, fields.wide_number("arm_length"));
  VLA_TRY(op.horn_radius, fields.wide_number("horn_radius"));
  if (op.horn_radius <= 0.0) return fields.wrong("horn_radius", "a length above 0");
  return op;
}

Result<BinsOp> parse_bins(JsonFields& fields) {
  BinsOp op;
  VLA_TRY(op.low, fields.wide_number("low"));
  VLA_TRY(op.high, fields.wide_number("high"));
  VLA_TRY(op.count, fields.integer("count", 1, kMaxVector));
  if (op.low >= op.high) return fields.wrong("high", "a number above low");
  return op;
}

/// Whether the network's own form of the state is reached, so that nothing may follow.
bool ends_state(const StateOp& op) {
  return std::holds_alternative<PadOp>(op) || std::holds_alternative<BinsOp>(op) || std::holds_alternative<DropOp>(op);
}

Status parse_state_op(JsonFields& fields, int, Recipe& recipe) {
  VLA_TRY(const int op, fields.choice("op", {"affine", "horn_angle", "normalize", "pad", "bins", "drop"}));
  const bool last_ends = !recipe.state.empty() && ends_state(recipe.state.back());
  if (last_ends) return misplaced(fields, "nothing after pad, bins or drop");
  const bool normalized = !recipe.state.empty() && std::holds_alternative<NormalizeOp>(recipe.state.back());
  if (op < 2 && normalized) return misplaced(fields, "the robot's conventions before normalize");
  StateOp state = DropOp{};
  if (op == 0) {
    VLA_TRY(state, parse_column_affine(fields));
  } else if (op == 1) {
    VLA_TRY(state, parse_horn_angle(fields));
  } else if (op == 2) {
    VLA_TRY(state, parse_normalize(fields));
  } else if (op == 3) {
    VLA_TRY(const int size, fields.integer("size", 1, kMaxVector));
    state = PadOp{size};
  } else if (op == 4) {
    VLA_TRY(state, parse_bins(fields));
  }
  recipe.state.push_back(std::move(state));
  return {};
}

Status parse_action_op(JsonFields& fields, int, Recipe& recipe) {
  VLA_TRY(const int op, fields.choice("op", {"take", "unnormalize", "add_state", "affine"}));
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
  } else {
    VLA_TRY(action, parse_column_affine(fields));
  }
  recipe.action.push_back(std::move(action));
  return {};
}

/// What one list makes, another must use: a state in words without a place for it would be lost without a word.
Status check_words(const Recipe& recipe) {
  const bool made = !recipe.state.empty() && std::holds_alternative<BinsOp>(recipe.state.back());
  bool used = false;
  for (const TextOp& op : recipe.text) {
    const auto* text = std::get_if<TemplateOp>(&op);
    used |= text != nullptr && text->text.find("{state}") != std::string::npos;
  }
  if (made == used) return {};
  return Error{Code::bad_bundle, std::string(kWhere) + ".text",
               made ? "a template with {state} for the state that ends in bins"
                    : "no {state}, or a state list that ends in bins",
               made ? "none" : "{state}"};
}

using ParseOp = Status (*)(JsonFields& fields, int index, Recipe& recipe);

Status parse_list(const Json& document, const char* name, ParseOp parse_op, Recipe& recipe) {
  const std::string where = std::string(kWhere) + "." + name;
  const auto list = document.find(name);
  if (list == document.end())
    return Error{Code::bad_bundle, where, "a list of ops", "no such field", "convert the checkpoint again"};
  if (!list->is_array()) return Error{Code::bad_bundle, where, "a list of ops", "another type"};
  for (std::size_t i = 0; i < list->size(); ++i) {
    VLA_TRY(JsonFields fields, JsonFields::open((*list)[i], where + "[" + std::to_string(i) + "]"));
    VLA_CHECK(parse_op(fields, static_cast<int>(i), recipe));
    VLA_CHECK(fields.done());
  }
  return {};
}

}  // namespace

Result<Recipe> parse_recipe(const std::string& json) {
  VLA_TRY(const Json document, parse_json(json, kWhere));
  if (!document.is_object()) return Error{Code::bad_bundle, kWhere, "a JSON object", "other text"};
  const std::map<std::string, ParseOp> lists = {
      {"image", parse_image_op}, {"text", parse_text_op}, {"state", parse_state_op}, {"action", parse_action_op}};
  Recipe recipe;
  for (const auto& [name, parse_op] : lists) VLA_CHECK(parse_list(document, name.c_str(), parse_op, recipe));
  for (const auto& item : document.items())
    if (!lists.contains(item.key()))
      return Error{Code::bad_bundle, std::string(kWhere) + "." + item.key(), "", "unknown field",
                   "this bundle needs a newer vla"};
  if (recipe.letterbox.width == 0)
    return Error{Code::bad_bundle, std::string(kWhere) + ".image", "a letterbox", "no op"};
  if (recipe.max_tokens == 0)
    return Error{Code::bad_bundle, std::string(kWhere) + ".text", "tokenize as the last op", "none"};
  VLA_CHECK(check_words(recipe));
  return recipe;
}

}  // namespace vla
