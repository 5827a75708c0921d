// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "modules/language/bart.h"

namespace vla {

/// BERT over one sentence: BART's encoder over the token embeddings plus the first sentence's embedding. The pooler is
/// left out. Source: transformers modeling_bert.py BertModel.
class Bert {
 public:
  explicit Bert(const Scope& s);

  /// ids [n] i32 -> [d_model, n].
  Tensor operator()(Graph& g, Tensor ids) const { return encoder_(g, embed(g, ids)); }
  /// The same at positions [n] i32; mask [n, n] or none.
  Tensor operator()(Graph& g, Tensor ids, Tensor positions, Tensor mask) const {
    return encoder_(g, embed(g, ids), positions, mask);
  }
  /// Errors: bad_bundle for more tokens than positions.
  Status check(int n_text) const;

  int d_model() const { return encoder_.d_model(); }

 private:
  Tensor embed(Graph& g, Tensor ids) const { return add(g, encoder_.token()(g, ids), g.parameter(sentence_)); }

  BartEncoder encoder_;
  const Param* sentence_;  // the embedding of the first of two sentences
};

}  // namespace vla
