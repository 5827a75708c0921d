// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "backend/work.h"

#include <ggml.h>

namespace vla {
namespace {

double bytes_of(const ggml_tensor* tensor) { return static_cast<double>(ggml_nbytes(tensor)); }

double flop_of(const ggml_tensor* node) {
  switch (node->op) {
    case GGML_OP_MUL_MAT:  // [k, m] x [k, n] -> [m, n]
      return 2.0 * static_cast<double>(ggml_nelements(node)) * static_cast<double>(node->src[0]->ne[0]);
    case GGML_OP_FLASH_ATTN_EXT:  // a product with the keys [d, n_key], and one with the values
      return 4.0 * static_cast<double>(ggml_nelements(node)) * static_cast<double>(node->src[1]->ne[1]);
    default:
      return 0;
  }
}

}  // namespace

Work work_of(const ggml_tensor* node) {
  double bytes = bytes_of(node);
  switch (node->op) {
    case GGML_OP_NONE:
    case GGML_OP_RESHAPE:
    case GGML_OP_VIEW:
    case GGML_OP_PERMUTE:
    case GGML_OP_TRANSPOSE:
      return {};
    case GGML_OP_GET_ROWS:  // of the table only the rows that are looked up
      return {0, bytes + bytes_of(node->src[1]) +
                     static_cast<double>(ggml_row_size(node->src[0]->type, node->ne[0]) * ggml_nrows(node))};
    case GGML_OP_CPY:  // the second operand is the place of the result
      return {0, bytes + bytes_of(node->src[0])};
    default:
      for (const ggml_tensor* source : node->src)
        if (source != nullptr) bytes += bytes_of(source);
      return {flop_of(node), bytes};
  }
}

}  // namespace vla
