// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "graph/work.h"

namespace vla {

double flop_of(const Node& node) {
  const auto result = static_cast<double>(count(node.shape));
  if (node.as<op::Linear>() != nullptr) return 2.0 * result * static_cast<double>(node.in[0].dim(0));
  if (const auto* channels = node.as<op::ChannelAttention>())
    return 4.0 * result * static_cast<double>(node.shape[0] / channels->n_group);
  const auto* attention = node.as<op::Attention>();
  if (attention == nullptr) return 0;  // only products are counted
  std::int64_t n_key = 0;
  for (std::size_t i = attention->has_mask ? 2 : 1; i < node.in.size(); i += 2) n_key += node.in[i].dim(2);
  return 4.0 * result * static_cast<double>(n_key);  // a product with the keys, and one with the values
}

}  // namespace vla
