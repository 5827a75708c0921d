// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/recipe.h"

#include <fmt/format.h>

#include <map>

#include "processor/recipe_ops.h"

namespace vla {
namespace {

using namespace recipe_ops;

constexpr const char* kWhere = "processor.recipe";

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
  if (list->size() > kMaxOps)
    return Error{Code::bad_bundle, where, fmt::format("at most {} ops", kMaxOps), std::to_string(list->size())};
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
  if (recipe.width == 0)
    return Error{Code::bad_bundle, std::string(kWhere) + ".image", "a letterbox, a resize or a size", "none"};
  if (recipe.max_tokens == 0)
    return Error{Code::bad_bundle, std::string(kWhere) + ".text", "tokenize as the last op", "none"};
  VLA_CHECK(check_words(recipe));
  return recipe;
}

}  // namespace vla
