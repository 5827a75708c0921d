// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "base/result.h"
#include "processor/ops/op.h"

namespace vla {

struct ViewsOp;

/// `processor.recipe` of docs/bundle.md, checked and typed: what happens to each input and to the actions, in order.
struct Recipe {
  std::unique_ptr<Fit> fit;                     // the first image op or ops: what follows works on planes of one size
  int width = 0, height = 0;                    // of those planes
  std::vector<std::unique_ptr<PlaneOp>> image;  // the others
  std::vector<std::unique_ptr<TextOp>> text;    // all but the last op, which is tokenize
  int max_tokens = 0;                           // 0: the policy reads no instruction
  bool keep_last = false;                       // of more tokens the last are kept, else the first
  std::vector<std::unique_ptr<StateOp>> state;
  std::vector<std::unique_ptr<ActionOp>> action;

  const ViewsOp* views = nullptr;   // the op of `text` that makes places for views
  bool drops_punctuation = false;   // an instruction of nothing else would be lost
  bool prompt_takes_state = false;  // a template has {state}
  bool discretizes_state = false;   // the state list ends in bins
};

/// Errors: bad_bundle, with a place like `processor.recipe.image[0].filter`, for anything the document does not name.
Result<Recipe> parse_recipe(const std::string& json);

}  // namespace vla
