// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/embedding.h"

#include <fmt/format.h>

#include <numeric>

#include "kernels/linear.h"

namespace vla {

Tensor constant_ids(Graph& g, const std::string& key, const std::vector<std::int32_t>& ids) {
  return g.constant("ids/" + key,
                    [&](Store& store) { return store.add_constant(ids, {static_cast<std::int64_t>(ids.size())}); });
}

Tensor counting_ids(Graph& g, int count) {
  std::vector<std::int32_t> ids(static_cast<std::size_t>(count));
  std::iota(ids.begin(), ids.end(), 0);
  return constant_ids(g, fmt::format("counting/{}", count), ids);
}

Embedding::Embedding(const Scope& s, int d_model, int n_row) : Module(s), weight_(s.table("weight", d_model, n_row)) {}

Tensor Embedding::forward(Graph& g, Tensor ids) const {
  return ggml_get_rows(g.context(), g.weight(weight_).node(), ids.node());
}

Tensor patches(Graph& g, Tensor images, int patch_size) {
  ggml_context* c = g.context();
  const int p = patch_size;
  ggml_tensor* kernel = ggml_new_tensor_4d(c, GGML_TYPE_F32, p, p, 3, 1);  // read for its shape only
  ggml_tensor* rows = ggml_im2col(c, kernel, images.node(), p, p, 0, 0, 1, 1, true, GGML_TYPE_F32);
  return ggml_reshape_3d(c, rows, rows->ne[0], rows->ne[1] * rows->ne[2], rows->ne[3]);
}

PatchEmbed::PatchEmbed(const Scope& s, int patch_size, int d_model)
    : Module(s),
      patch_size_(patch_size),
      weight_(s.matrix("weight", 3 * patch_size * patch_size, d_model)),
      bias_(s.vector("bias", d_model)) {}

Tensor PatchEmbed::forward(Graph& g, Tensor images) const {
  return kernels::linear(g, {weight_, bias_}, patches(g, images, patch_size_));
}

}  // namespace vla
