// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <variant>
#include <vector>

#include "base/result.h"
#include "processor/letterbox.h"
#include "processor/pipeline.h"
#include "processor/resize.h"
#include "processor/standardize.h"

namespace vla {

/// How a normalize or unnormalize step uses statistics; `vector.h` has the formulas.
enum class NormKind {
  mean_std,
  min_max,
  quantiles,
  quantile10,
  identity,
  openpi_mean_std,
  openpi_quantiles,
  evo1_mean_std,
  evo1_min_max,
  evo1_quantiles,
  groot_min_max,
  groot_mean_std
};

/// The kinds of GR00T, whose statistics are those of all features together, as they follow each other.
inline bool is_groot(NormKind kind) { return kind == NormKind::groot_min_max || kind == NormKind::groot_mean_std; }

struct AffineOp {
  float scale = 1.0f;
  float shift = 0.0f;
};

struct ClipOp {
  float low = 0.0f;
  float high = 0.0f;
};

struct StripOp {};

/// Small letters for capitals, and nothing but letters, digits, white space and underscores: see `python_text.h`.
struct LowerOp {};
struct DropPunctuationOp {};

struct ReplaceOp {
  std::string from, to;
};

struct EnsureSuffixOp {
  std::string suffix;
};

/// `{instruction}` stands for the text so far, `{state}` for the numbers that `bins` made of the state.
struct TemplateOp {
  std::string text;
};

/// `count` pieces in front of the text so far, or behind it, one for each view that the network has a place for: `open`
/// with the number of the piece, from 1, for `{i}` where it stands, then `token` `repeat` times, then `close`.
struct ViewsOp {
  int count = 0;
  int repeat = 0;
  bool behind = false;
  std::string open, token, close;
};

struct NormalizeOp {
  NormKind kind = NormKind::identity;
  std::string stats;  // prefix of the statistics' tensor names; empty for identity
  double eps = 0.0;
  std::string feature;  // full name of the state feature it works on; empty: the whole vector
};

/// `x * scale + shift` in the columns named.
struct ColumnAffineOp {
  std::vector<int> columns;
  double scale = 1.0;
  double shift = 0.0;
};

/// The opening of a gripper, `x * scale + shift`, as the angle of the servo horn that drives it, by the lengths of horn
/// and arm. It is one op because the angle of a horn near its end depends on the last digit of the opening.
struct HornAngleOp {
  std::vector<int> columns;
  double scale = 1.0;
  double shift = 0.0;
  double arm_length = 0.0;
  double horn_radius = 0.0;
};

/// Numbers to whole numbers: how many of `count` evenly spaced edges from `low` on (`high` left out) are not above,
/// less 1.
struct BinsOp {
  double low = 0.0;
  double high = 0.0;
  int count = 0;
};

/// The network sees no state.
struct DropOp {};

struct PadOp {
  int size = 0;
  float value = 0.0f;
};

/// The first rows of a chunk, which are what the robot is meant to do.
struct RowsOp {
  int count = 0;
};

struct TakeOp {
  int size = 0;
};

/// Adds the state, as it is before its normalization, to the columns named.
struct AddStateOp {
  std::vector<int> columns;
};

/// In the columns named, `then` for what is strictly above `above`, `otherwise` for the rest.
struct ThresholdOp {
  std::vector<int> columns;
  float above = 0.0f;
  float then = 0.0f;
  float otherwise = 0.0f;
};

using Fit = std::variant<Letterbox, Resize, Pipeline>;
using ImageOp = std::variant<AffineOp, ClipOp, Standardize>;
using TextOp = std::variant<StripOp, LowerOp, DropPunctuationOp, ReplaceOp, EnsureSuffixOp, TemplateOp, ViewsOp>;
using StateOp = std::variant<ColumnAffineOp, HornAngleOp, NormalizeOp, ClipOp, PadOp, BinsOp, DropOp>;
using ActionOp = std::variant<RowsOp, TakeOp, ClipOp, NormalizeOp, AddStateOp, ColumnAffineOp, ThresholdOp>;

/// `processor.recipe` of docs/bundle.md, checked and typed: what happens to each input and to the actions, in order.
struct Recipe {
  Fit fit;                     // the first image op or ops: what follows works on planes of one size
  int width = 0, height = 0;   // of those planes
  std::vector<ImageOp> image;  // the others
  std::vector<TextOp> text;    // all but the last op, which is tokenize
  int max_tokens = 0;
  bool keep_last = false;  // of more tokens the last are kept, else the first
  std::vector<StateOp> state;
  std::vector<ActionOp> action;
};

/// Largest picture and vector that a recipe may ask for: a damaged number must not ask for all memory.
inline constexpr int kMaxImageSide = 8192;
inline constexpr int kMaxVector = 65536;
inline constexpr std::size_t kMaxPictureOps = 16;
inline constexpr std::size_t kMaxOps = 64;          // of one list
inline constexpr std::size_t kMaxOpText = 1 << 12;  // bytes of a text that an op looks for or writes
inline constexpr int kMaxViews = 32;
inline constexpr std::size_t kMaxViewsText = 1 << 20;  // bytes that a views op puts in front

/// Errors: bad_bundle, with a place like `processor.recipe.image[0].filter`, for anything the document does not name.
Result<Recipe> parse_recipe(const std::string& json);

}  // namespace vla
