// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <functional>
#include <span>
#include <vector>

#include "modules/language/qwen.h"
#include "modules/vision/patch_merger.h"
#include "modules/vision/qwen_vit.h"

namespace vla {

/// Places of a prompt's tokens: those of a picture of n_row x n_column tokens, which starts at each of `view_starts`,
/// share a time and count rows and columns from it; text counts on behind the farthest of them.
/// Source: transformers modeling_qwen3_vl.py Qwen3VLModel.get_rope_index.
std::vector<Place> prompt_places(std::span<const int> view_starts, int n_row, int n_column, int n_token);

/// Qwen3-VL as a policy uses it: pictures and text become the features of one sequence. The first layers of the
/// language model get what inner layers of the tower saw, added to the tokens of the pictures (DeepStack).
/// Reads `vision.*`, `connector.*`, `deepstack.*`, `lm.*`, `policy.n_slot` and `policy.view_starts`.
/// Source: the same file, Qwen3VLModel.
class Qwen3Vl {
 public:
  /// `s` is the root of the tree.
  explicit Qwen3Vl(const Scope& s);

  /// Errors: bad_bundle, unsupported.
  Status check(int width, int height, int n_view, int n_token) const;
  /// Load rate: what depends on the weights alone.
  void keep(Graph& g, Cache& cache) const { vision_.keep(g, cache); }
  /// images [width, height, 3, n_slot], tokens [n] i32 with any ids where pictures stand -> features [d_model, n].
  Tensor operator()(Graph& g, Tensor images, Tensor tokens, const Cache& cache) const;

  /// The rows of the pictures, and all others.
  struct Rows {
    Tensor image, text;
  };
  Rows split(Graph& g, Tensor features) const;

  int d_model() const { return lm_.d_model(); }
  /// Tokens of a view.
  int n_view_token() const { return vision_.n_token_row() * vision_.n_token_column(); }

 private:
  /// The ranges of text between the views: n_slot + 1 of them, any but the first may be empty.
  struct Range {
    int first, count;
  };
  std::vector<Range> text_ranges(int n_token) const;
  /// Views [d_model, n_view_token, n_slot] at their places among text rows.
  Tensor arrange(Graph& g, Tensor views, int n_token, const std::function<Tensor(Range)>& text) const;

  QwenVit vision_;
  Qwen lm_;
  PatchMerger connector_;
  std::vector<PatchMerger> deepstack_;
  std::array<int, 3> rope_sections_ = {};
  std::vector<int> view_starts_;
};

}  // namespace vla
