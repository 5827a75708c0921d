// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "modules/detr.h"
#include "nn/embedding.h"

namespace vla {

/// BERT over one sentence: all tokens see each other, norms are behind the sums, positions are learned. Its pooler is
/// not part of it. Source: transformers modeling_bert.py BertModel.
class Bert {
 public:
  explicit Bert(const Scope& s);

  /// ids [n] i32 -> [d_model, n].
  Tensor operator()(Graph& g, Tensor ids) const;
  /// Errors: bad_bundle for more tokens than positions.
  Status check(int n_text) const;

  int d_model() const { return family_.d_model; }

 private:
  DetrFamily family_;
  int n_position_;
  Embedding token_;
  const Param* sentence_;  // the row of the first of two sentences
  Embedding position_;
  LayerNorm norm_;
  std::vector<DetrEncoderLayer> layers_;
};

}  // namespace vla
