// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <span>
#include <vector>

#include "modules/language/qwen.h"
#include "modules/language/view_places.h"
#include "modules/vision/patch_merger.h"
#include "modules/vision/qwen_vit.h"

namespace vla {

/// mRoPE position ids of a prompt's tokens: those of an image of n_row x n_column tokens, which starts at each of
/// `view_starts`, share a time and count rows and columns from it; text counts on behind the farthest of them. Source:
/// transformers modeling_qwen3_vl.py Qwen3VLModel.get_rope_index.
std::vector<PositionId> mrope_position_ids(std::span<const int> view_starts, int n_row, int n_column, int n_token);

/// Qwen3-VL as a policy uses it: images and text become the features of one sequence. The first layers of the
/// language model get what inner layers of the tower saw, added to the tokens of the images (DeepStack).
/// Reads `vision.*`, `connector.*`, `deepstack.*`, `lm.*` and the places of the views.
/// Source: the same file, Qwen3VLModel.
class Qwen3Vl {
 public:
  /// `s` is the root of the tree.
  explicit Qwen3Vl(const Scope& s);

  /// Errors: bad_bundle, unsupported.
  Status check(int width, int height, int n_view, int n_token) const;
  /// Load rate: what depends on the weights alone.
  void keep(Graph& g, Cache& cache) const { vision_.keep(g, cache); }
  /// images [width, height, 3, max_views], tokens [n] i32 with any ids where images stand -> features [d_model, n].
  Tensor operator()(Graph& g, Tensor images, Tensor tokens, const Cache& cache) const;

  const ViewPlaces& places() const { return places_; }
  int d_model() const { return lm_.d_model(); }

 private:
  QwenVit vision_;
  Qwen lm_;
  PatchMerger connector_;
  std::vector<PatchMerger> deepstack_;
  std::array<int, 3> rope_sections_ = {};
  ViewPlaces places_;
};

}  // namespace vla
