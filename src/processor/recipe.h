// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <variant>
#include <vector>

#include "base/result.h"
#include "processor/letterbox.h"

namespace vla {

/// How a normalize or unnormalize step uses statistics; `vector.h` has the formulas.
enum class NormKind { mean_std, min_max, quantiles, quantile10, identity };

struct AffineOp {
  float scale = 1.0f;
  float shift = 0.0f;
};

struct EnsureSuffixOp {
  std::string suffix;
};

struct NormalizeOp {
  NormKind kind = NormKind::identity;
  std::string stats;  // prefix of the statistics' tensor names; empty for identity
  float eps = 0.0f;
  std::string feature;  // full name of the state feature it works on; empty: the whole vector
};

struct PadOp {
  int size = 0;
};

struct TakeOp {
  int size = 0;
};

using StateOp = std::variant<NormalizeOp, PadOp>;
using ActionOp = std::variant<TakeOp, NormalizeOp>;

/// `processor.recipe` of docs/bundle.md, checked and typed: what happens to each input and to the actions, in order.
struct Recipe {
  Letterbox letterbox;               // the first image op: what follows works on planes of one size
  std::vector<AffineOp> image;       // the others
  std::vector<EnsureSuffixOp> text;  // all but the last op, which is tokenize
  int max_tokens = 0;
  bool keep_last = false;  // of more tokens the last are kept, else the first
  std::vector<StateOp> state;
  std::vector<ActionOp> action;
};

/// Largest picture and vector that a recipe may ask for: a damaged number must not ask for all memory.
inline constexpr int kMaxImageSide = 8192;
inline constexpr int kMaxVector = 65536;

/// Errors: bad_bundle, with a place like `processor.recipe.image[0].filter`, for anything the document does not name.
Result<Recipe> parse_recipe(const std::string& json);

}  // namespace vla
