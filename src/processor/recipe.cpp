// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/recipe.h"

#include <functional>
#include <map>

#include "processor/json_fields.h"

namespace vla {
namespace {

constexpr const char* kWhere = "processor.recipe";

Error misplaced(const JsonFields& fields, const char* expected) { return fields.wrong("op", expected); }

Status parse_letterbox(JsonFields& fields, Letterbox& op) {
  VLA_TRY(op.width, fields.integer("width", 1, kMaxImageSide));
  VLA_TRY(op.height, fields.integer("height", 1, kMaxImageSide));
  VLA_CHECK(fields.choice("filter", {"bilinear"}));
  VLA_TRY(const bool antialias, fields.boolean("antialias"));
  if (antialias) return fields.wrong("antialias", "false");
  VLA_CHECK(fields.choice("align", {"bottom_right"}));
  VLA_TRY(op.fill, fields.number("fill"));
  return {};
}

Status parse_image_op(JsonFields& fields, int index, Recipe& recipe) {
  VLA_TRY(const int op, fields.choice("op", {"letterbox", "affine"}));
  if (op == 0)
    return index == 0 ? parse_letterbox(fields, recipe.letterbox) : misplaced(fields, "one letterbox, first");
  if (index == 0) return misplaced(fields, "a letterbox first");
  AffineOp affine;
  VLA_TRY(affine.scale, fields.number("scale"));
  VLA_TRY(affine.shift, fields.number("shift"));
  recipe.image.push_back(affine);
  return {};
}

Status parse_text_op(JsonFields& fields, int, Recipe& recipe) {
  VLA_TRY(const int op, fields.choice("op", {"ensure_suffix", "tokenize"}));
  if (recipe.max_tokens > 0) return misplaced(fields, "nothing after tokenize");
  if (op == 0) {
    VLA_TRY(const std::string suffix, fields.string("suffix"));
    recipe.text.push_back({suffix});
    return {};
  }
  VLA_TRY(recipe.max_tokens, fields.integer("max_tokens", 1, kMaxVector));
  VLA_TRY(const int truncate, fields.choice("truncate", {"right", "left"}));
  recipe.keep_last = truncate == 1;
  return {};
}

Result<NormalizeOp> parse_normalize(JsonFields& fields) {
  NormalizeOp op;
  VLA_TRY(const int kind, fields.choice("kind", {"mean_std", "min_max", "quantiles", "quantile10", "identity"}));
  op.kind = static_cast<NormKind>(kind);
  const bool identity = op.kind == NormKind::identity;
  if (!identity || fields.has("stats")) {
    VLA_TRY(op.stats, fields.string("stats"));
  }
  if (!identity || fields.has("eps")) {
    VLA_TRY(op.eps, fields.number("eps"));
  }
  if (op.eps < 0.0f) return fields.wrong("eps", "a number that is not negative");
  if (fields.has("feature")) {
    VLA_TRY(op.feature, fields.string("feature"));
  }
  return op;
}

Status parse_state_op(JsonFields& fields, int, Recipe& recipe) {
  VLA_TRY(const int op, fields.choice("op", {"normalize", "pad"}));
  if (!recipe.state.empty() && std::holds_alternative<PadOp>(recipe.state.back()))
    return misplaced(fields, "nothing after pad");
  if (op == 0) {
    VLA_TRY(NormalizeOp normalize, parse_normalize(fields));
    recipe.state.push_back(std::move(normalize));
    return {};
  }
  VLA_TRY(const int size, fields.integer("size", 1, kMaxVector));
  recipe.state.push_back(PadOp{size});
  return {};
}

Status parse_action_op(JsonFields& fields, int, Recipe& recipe) {
  VLA_TRY(const int op, fields.choice("op", {"take", "unnormalize"}));
  if (op == 0) {
    VLA_TRY(const int size, fields.integer("size", 1, kMaxVector));
    recipe.action.push_back(TakeOp{size});
    return {};
  }
  VLA_TRY(NormalizeOp unnormalize, parse_normalize(fields));
  if (!unnormalize.feature.empty()) return fields.wrong("feature", "no such field here");
  recipe.action.push_back(std::move(unnormalize));
  return {};
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
  return recipe;
}

}  // namespace vla
