// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/embedding.h"

#include <fmt/format.h>

#include <numeric>

namespace vla {

Tensor constant_ids(Graph& g, const std::string& key, const std::vector<std::int32_t>& ids) {
  return g.constant_ids(key, [&] { return ids; });
}

Tensor arange(Graph& g, int count) {
  return g.constant_ids(fmt::format("arange/{}", count), [&] {
    std::vector<std::int32_t> ids(static_cast<std::size_t>(count));
    std::iota(ids.begin(), ids.end(), 0);
    return ids;
  });
}

Embedding::Embedding(const Scope& s, int d_model, int n_row) : Module(s), weight_(s.table("weight", d_model, n_row)) {}

Tensor patches(Graph& g, Tensor images, int patch_size) { return g.add(op::Patches{patch_size}, {images}); }

PatchEmbed::PatchEmbed(const Scope& s, int patch_size, int d_model)
    : Module(s), patch_size_(patch_size), product_(s, 3 * patch_size * patch_size, d_model, Bias::yes) {}

Tensor PatchEmbed::forward(Graph& g, Tensor images) const {
  return product_.forward(g, patches(g, images, patch_size_));
}

}  // namespace vla
