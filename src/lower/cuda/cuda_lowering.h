// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/attention.h"
#include "lower/cuda/cuda_queue.h"
#include "lower/cuda/cuda_weights.h"
#include "lower/ops.h"

/// The passes of a GPU: what its kernels need to lie contiguously, and a launch for each operation.
namespace vla::lower {

/// Rows of heads, normed and turned, for attention, which may want them as bf16.
struct HeadOp {
  HeadRows rows;

  std::string text() const { return rows.text() + "heads"; }
  double flop() const { return 0; }
};

struct CudaOp : Step {
  AnyOp<HeadOp> op;
  ValueId gate = kNone;     // of a gated product, what its first matrix makes; none where one kernel multiplies both
  int n_split = 1;          // shares of the depth, or of keys, of blocks of their own
  ValueId partial = kNone;  // what those leave
};

struct CudaLowering : Lowering {
  const CudaWeights& weights;
  int n_sm;  // blocks that run at a time
  bool is_hopper;
  std::vector<CudaOp> ops = {};
  std::vector<cuda::Address> data = {};  // of each base, when memory is there

  /// Elements of values that are not float32 are those of a whole base.
  cuda::Address address(ValueId id) const {
    const Value& v = value(id);
    return data[static_cast<std::size_t>(v.base)] + static_cast<cuda::Address>(v.offset) * 4;
  }
  template <class T = float>
  T* at(ValueId id) const {
    return id == kNone ? nullptr : reinterpret_cast<T*>(address(id));
  }
  template <class T = float>
  const T* param(const Param* of) const {
    return of == nullptr ? nullptr : reinterpret_cast<const T*>(weights[*of].data);
  }
  const CudaWeight& matrix(const Node& linear) const { return weights[*linear.as<op::Linear>()->weight]; }
};

/// Has operations read what their kernels can: copies what lies otherwise, rounds what is multiplied as bf16 or codes,
/// and norms and turns heads before attention, which takes keys and values where they lie, or as bf16. What is only
/// rounded is stored so at once. Also how the depth of a product is split.
void choose_layouts(CudaLowering& l, std::vector<FusedOp> ops);

/// How blocks of a product cut rows: in 128, in 64, or few rows bound by reading the matrix; strips are of so many
/// columns of up to 64 rows; Hopper has tiles of its own. And how many shares of the depth have blocks of their own.
enum class ProductShape { few, strip16, strip32, strip64, strip128, rows64, rows128, hopper };
/// Columns of a strip; 0 for other shapes.
constexpr std::int64_t strip_width(ProductShape shape) {
  return shape == ProductShape::strip16    ? 16
         : shape == ProductShape::strip32  ? 32
         : shape == ProductShape::strip64  ? 64
         : shape == ProductShape::strip128 ? 128
                                           : 0;
}
struct ProductCut {
  ProductShape shape;
  int n_split;
  std::size_t tile = 0;  // of kHopperTiles or kHopperInt8Tiles
  double us = 0;         // that it takes on Hopper, as it was estimated
};
/// The width of strips of several products together whose depth is not split, 16 to 64.
unsigned common_width(std::int64_t n_row, std::int64_t n_column, std::int64_t depth, int n_sm);
/// The tile for Hopper that takes the shortest time.
ProductCut cut_for_hopper(MatrixKind kind, std::int64_t n_row, std::int64_t n_column, std::int64_t depth, bool is_gated,
                          int n_sm);
/// is_gated: one kernel multiplies both matrices of a gated product, which have n_column together.
ProductCut cut_product(const CudaLowering& l, MatrixKind kind, std::int64_t n_row, std::int64_t n_column,
                       std::int64_t depth, bool is_gated);

/// How blocks cut rows of queries and shares of keys.
struct AttentionPlan {
  const cuda::AttentionShape* shape;  // on tensor cores, else null
  int n_split;
};
/// The fastest on tensor cores, by estimates. n_row: of each of n_unit heads of keys in a batch.
AttentionPlan plan_attention(std::int64_t d_head, std::int64_t n_row, std::int64_t n_unit, std::int64_t n_key,
                             int n_sm);
AttentionPlan plan_attention(const CudaLowering& l, const AttentionOp& op);

/// As Program::work counts it.
Work work_of(const CudaLowering& l, const CudaOp& op);

}  // namespace vla::lower
