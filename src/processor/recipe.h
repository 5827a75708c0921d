// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "base/result.h"
#include "processor/ops/op.h"

namespace vla {

struct ViewsOp;

/// The parsed and checked `processor.recipe` (docs/bundle.md): the ops on each input and on the actions, in order.
struct Recipe {
  std::unique_ptr<Fit> fit;                        // the first image op or ops; later ops work on planes of one size
  int width = 0, height = 0;                       // size of those planes
  std::vector<std::unique_ptr<PlaneOp>> image;     // the other image ops
  std::vector<std::unique_ptr<TextOp>> text;       // all ops that change the text
  int max_tokens = 0;                              // 0: the policy reads no instruction
  std::map<std::string, int, std::less<>> limits;  // limits below max_tokens, for single instructions
  std::optional<int> pad_id;                       // fills a text up to its limit
  bool keep_last = false;                          // keeps the last tokens of a text that is too long, else the first
  std::vector<std::unique_ptr<StateOp>> state;
  std::vector<std::unique_ptr<ActionOp>> action;

  const ViewsOp* views = nullptr;   // the op of `text` that adds the views, or null
  bool drops_punctuation = false;   // an op removes punctuation, so an instruction of nothing else would be lost
  bool prompt_takes_state = false;  // a template has {state}
  bool discretizes_state = false;   // the state list ends in bins

  /// Limits of texts, in tokens: `max_tokens`, and those of single instructions.
  std::vector<int> text_limits() const;
};

/// Errors: bad_bundle with a place like `processor.recipe.image[0].filter`, for anything that the document does not
/// define.
Result<Recipe> parse_recipe(const std::string& json);

/// Applies the ops of `recipe.image` for this view to the values `first` to first + n - 1 of each of the three channels
/// of `planes`. With PlaneOp::kEveryView it applies only the ops for all views. Each value changes independently of the
/// others.
void apply_ops(const Recipe& recipe, int view, std::span<float> planes, std::size_t first, std::size_t n);

}  // namespace vla
