// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/recipe.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>

#include "processor/json_fields.h"

// The table of ops: one function of each file in ops/.
#define OPS(file)   \
  namespace vla {   \
  Ops file##_ops(); \
  }
#include "processor/recipe_ops.inc"
#undef OPS

namespace vla {
namespace {

constexpr const char* kRecipeKey = "processor.recipe";
constexpr std::array<const char*, 4> kLists = {"image", "text", "state", "action"};
constexpr std::size_t kMaxOps = 64;  // in one list

const Ops& all_ops() {
  static const Ops ops = [] {
    Ops all;
    for (const auto& part : {
#define OPS(file) file##_ops(),
#include "processor/recipe_ops.inc"
#undef OPS
         })
      all.insert(all.end(), part.begin(), part.end());
    return all;
  }();
  return ops;
}

Status parse_op(const char* list, JsonFields& fields, Recipe& recipe) {
  std::vector<const OpEntry*> known;
  std::vector<const char*> names;
  for (const OpEntry& entry : all_ops())
    if (std::string_view(entry.list) == list) {
      known.push_back(&entry);
      names.push_back(entry.name);
    }
  VLA_TRY(const int index, fields.choice("op", names));
  VLA_CHECK(known[static_cast<std::size_t>(index)]->parse(fields, recipe));
  return fields.done();
}

Status parse_list(const Json& document, const char* name, Recipe& recipe) {
  const std::string where = std::string(kRecipeKey) + "." + name;
  const auto list = document.find(name);
  if (list == document.end())
    return Error{Code::bad_bundle, where, "a list of ops", "no such field", "convert the checkpoint again"};
  if (!list->is_array()) return Error{Code::bad_bundle, where, "a list of ops", "another type"};
  if (list->size() > kMaxOps)
    return Error{Code::bad_bundle, where, fmt::format("at most {} ops", kMaxOps), std::to_string(list->size())};
  for (std::size_t i = 0; i < list->size(); ++i) {
    VLA_TRY(JsonFields fields, JsonFields::open((*list)[i], fmt::format("{}[{}]", where, i)));
    VLA_CHECK(parse_op(name, fields, recipe));
  }
  return {};
}

/// Checks across lists: a discretized state without a place in the prompt would be lost silently.
Status check_state(const Recipe& recipe) {
  if (recipe.discretizes_state == recipe.prompt_takes_state) return {};
  return Error{Code::bad_bundle, std::string(kRecipeKey) + ".text",
               recipe.discretizes_state ? "a template with {state} for the state that ends in bins"
                                        : "no {state}, or a state list that ends in bins",
               recipe.discretizes_state ? "none" : "{state}"};
}

}  // namespace

std::vector<int> Recipe::text_limits() const {
  std::vector<int> all = {max_tokens};
  for (const auto& [instruction, limit] : limits) all.push_back(limit);
  return all;
}

namespace {

/// The fit of a policy without views, which refuses every frame.
struct NoImages final : Fit {
  const char* described() const override { return "none"; }
  Status apply(const Frame&, int, std::span<float>, const std::string& where) const override {
    return Error{Code::bad_observation, where, "no image, since the policy reads none", "an image"};
  }
};

}  // namespace

Result<Recipe> parse_recipe(const std::string& json) {
  VLA_TRY(const Json document, parse_json(json, kRecipeKey));
  if (!document.is_object()) return Error{Code::bad_bundle, kRecipeKey, "a JSON object", "other text"};
  Recipe recipe;
  for (const char* list : kLists) VLA_CHECK(parse_list(document, list, recipe));
  for (const auto& item : document.items())
    if (std::find(kLists.begin(), kLists.end(), item.key()) == kLists.end())
      return Error{Code::bad_bundle, std::string(kRecipeKey) + "." + item.key(), "", "unknown field",
                   "this bundle needs a newer vla"};
  const auto images = document.find("image");
  if (images != document.end() && images->is_array() && images->empty())
    recipe.fit = std::make_unique<NoImages>();
  else if (recipe.width == 0)
    return Error{Code::bad_bundle, std::string(kRecipeKey) + ".image", "a letterbox, a resize or a size", "none"};
  if (recipe.max_tokens == 0 && !recipe.text.empty())
    return Error{Code::bad_bundle, std::string(kRecipeKey) + ".text", "tokenize as the last op", "none"};
  VLA_CHECK(check_state(recipe));
  return recipe;
}

void apply_ops(const Recipe& recipe, int view, std::span<float> planes, std::size_t first, std::size_t n) {
  constexpr std::size_t kChannels = 3;
  for (const auto& op : recipe.image)
    if (op->view() == PlaneOp::kEveryView || op->view() == view)
      for (std::size_t c = 0; c < kChannels; ++c)
        op->apply(planes.subspan(c * planes.size() / kChannels + first, n), c);
}

}  // namespace vla
