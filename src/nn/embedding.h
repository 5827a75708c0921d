// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "nn/linear.h"

namespace vla {

/// Constant ids of a table's rows: [ids.size()] i32. `key` identifies the list within a graph.
Tensor constant_ids(Graph& g, const std::string& key, const std::vector<std::int32_t>& ids);
/// 0, 1, ... count - 1.
Tensor arange(Graph& g, int count);

/// Rows of a table. ids [n] i32 -> [d_model, n]. Ids must be below n_row; the caller checks.
class Embedding : public Module<Embedding> {
 public:
  Embedding(const Scope& s, int d_model, int n_row);
  Tensor forward(Graph& g, Tensor ids) const { return g.add(op::Embedding{weight_}, {ids}); }

 private:
  const Param* weight_;
};

/// The pixels of non-overlapping patches, row by row: images [width, height, 3, n_view] -> [3 * patch_size^2, n_patch,
/// n_view]. A patch is ordered by channel, row, column.
Tensor patches(Graph& g, Tensor images, int patch_size);

/// Projects non-overlapping patches with one product, which equals a convolution whose kernel size and stride are
/// `patch_size`.
/// images [width, height, 3, n_view] -> [d_model, n_patch, n_view], patches row by row.
class PatchEmbed : public Module<PatchEmbed> {
 public:
  PatchEmbed(const Scope& s, int patch_size, int d_model);
  Tensor forward(Graph& g, Tensor images) const;

 private:
  int patch_size_;
  Linear product_;
};

}  // namespace vla
