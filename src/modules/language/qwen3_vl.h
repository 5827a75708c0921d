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

/// mRoPE position ids of a prompt. An image of n_row x n_column tokens begins at each of `view_starts`: its tokens
/// share a time, and rows and columns count from it. Text continues after the largest id so far. Source: transformers
/// modeling_qwen3_vl.py Qwen3VLModel.get_rope_index.
std::vector<PositionId> mrope_position_ids(std::span<const int> view_starts, int n_row, int n_column, int n_token);

/// Qwen3-VL as a policy uses it: images and text become the features of one sequence. Features of inner tower layers
/// are added to the image tokens in the first layers of the language model (DeepStack). Reads `vision.*`,
/// `connector.*`, `deepstack.*`, `lm.*` and the places of the views. Source: the same file, Qwen3VLModel.
class Qwen3Vl {
 public:
  /// `s` is the root of the tree.
  explicit Qwen3Vl(const Scope& s);

  /// Errors: bad_bundle, unsupported.
  Status check(int width, int height, int n_view, int n_token) const;
  /// Load rate: computes the values that depend only on weights.
  void keep(Graph& g, Cache& cache) const { vision_.keep(g, cache); }
  /// images [width, height, 3, max_views], tokens [n] i32, ignored at the images' places -> features [d_model, n].
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
