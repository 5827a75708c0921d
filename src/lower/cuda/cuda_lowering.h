// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <optional>

#include "cuda/kernels/attention.h"
#include "cuda/kernels/hopper_flash.h"
#include "cuda/kernels/linear_bf16.h"
#include "kernels/sizes.h"
#include "lower/cuda/cuda_queue.h"
#include "lower/cuda/cuda_ways.h"
#include "lower/cuda/cuda_weights.h"
#include "lower/ops.h"

/// A GPU's passes: copy operands that kernels need contiguous, and make the launches of each operation.
namespace vla::lower {

using kernels::ceil_div;

/// Norms and rotates rows of heads for attention, and converts them to bf16 if attention reads that.
struct HeadOp {
  HeadRows rows;

  std::string text() const { return rows.text() + "heads"; }
  double flop() const { return 0; }
};

/// A product's blocks, and the number of shares that its depth is split into.
struct ProductCut {
  cuda::Bf16Shape shape = cuda::Bf16Shape::few;  // also of codes: few or rowsN; with a Hopper tile rows128
  int n_split = 1;                               // shares of the depth, each with its own blocks
  std::optional<std::size_t> tile = {};          // of Hopper: index into kHopperTiles or kHopperInt8Tiles
  bool in_cluster = false;                       // of Hopper: a cluster's blocks add the shares
  double us = 0;                                 // estimated time on Hopper
  bool by_tma = false;                           // of Hopper: TMA fetches the tile's operands (hopper_tma.h)
};
/// How attention is cut into blocks of query rows and shares of the keys.
struct AttentionPlan {
  const cuda::AttentionShape* shape = nullptr;  // null: no tensor cores, or `flash`
  const cuda::FlashShape* flash = nullptr;      // of Hopper: by wgmma
  int n_split = 1;                              // shares of the keys, each with its own blocks
  bool in_cluster = false;                      // of Hopper: a cluster's blocks combine the shares
  double us = 0;                                // estimated time on Hopper, on tensor cores
};

/// The rotation of heads by the product that makes them (cuda::Rotation).
struct HeadRotation {
  ValueId table = kNone;  // kNone: nothing is rotated
  std::int64_t d_head = 0, n_token = 0;
};

/// A norm that one product begins and others end (cuda::NormBegin, cuda::NormEnd).
struct HalvedNorm {
  ValueId squares = kNone, sums = kNone;  // moments, [n_row, n_part]; without squares there is no such norm
  ValueId rows = kNone;                   // what the norm's products read
  ValueId weight = kNone, bias = kNone;
  int n_part = 0, part = 0;
  float eps = 0;

  /// The values that the norm's products read beside `rows`.
  std::vector<ValueId> moments() const { return sums == kNone ? std::vector{squares} : std::vector{squares, sums}; }
  int n_more() const { return cuda::rows_of_norm(sums != kNone, bias != kNone); }
};

struct CudaOp : Step {
  AnyOp<HeadOp> op;
  ProductCut cut = {};         // LinearOp only
  AttentionPlan plan = {};     // AttentionOp only
  ValueId gate = kNone;        // the gate product's result, if no kernel computes gate and up together
  ValueId partial = kNone;     // partial results of the shares of the depth or of the keys; none of a cluster
  HeadRotation rotation = {};  // LinearOp only
  HalvedNorm begins = {};      // LinearOp only: of its result
  HalvedNorm ends = {};        // LinearOp only: of its x
  std::shared_ptr<const CudaOp> finishes = nullptr;  // norms only: the product whose depth shares are added first
};
/// Whether another operation adds the depth shares of this product.
inline bool leaves_shares(const CudaOp& op) { return op.partial != kNone && op.writes[0] == op.partial; }

struct CudaLowering : Lowering {
  CudaLowering(Lowering of, const CudaWeights& loaded, const CudaQueue& queue, const CudaWays& used)
      : Lowering(std::move(of)),
        weights(loaded),
        gpu(queue.gpu().get()),
        n_sm(queue.n_sm()),
        is_hopper(queue.is_hopper()),
        ways(used) {}

  const CudaWeights& weights;
  const cuda::Gpu* gpu;  // null for a model of one
  int n_sm;              // SMs of the device
  bool is_hopper;
  CudaWays ways;
  std::vector<CudaOp> ops = {};
  std::vector<cuda::Address> data = {};  // address of each base, once memory is allocated

  /// The address of a value. A value that is not float32 must be a whole base.
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

/// Makes operands readable for the kernels: copies operands with a wrong layout, converts the inputs of bf16 and int8
/// products, and norms and rotates heads before attention. Attention reads keys and values in place, or as bf16. A
/// value whose only reader is such a conversion is stored converted, and some products rotate the heads that they make.
/// Also splits the depth of products, and lets norms add the shares.
void choose_layouts(CudaLowering& l, std::vector<FusedOp> ops);
/// Lets products of a solver step begin and end norms where that is faster than an operation for the norm, and removes
/// those operations. Part of choose_layouts, before shares have values.
void halve_norms(CudaLowering& l);
/// Whether all matrices of a product are bf16.
bool is_of_bf16(const CudaLowering& l, const LinearOp& product);
/// The operation whose first result is this value, or null.
CudaOp* maker_of(CudaLowering& l, ValueId id);

/// Whether a bf16 product of this many rows uses strips. With more rows, tiles of both operands in shared memory are
/// faster despite their barriers.
bool is_of_strips(std::int64_t n_row, std::int64_t depth);

/// The strip width, 16 to 64, for several products in one launch without split depth.
unsigned common_width(std::int64_t n_row, std::int64_t n_column, std::int64_t depth, int n_sm);
/// What a Hopper tile computes: one product, both products of a gated MLP, several products in one launch, or one
/// product and the first half of a norm of it, whose shares no other kernel adds. Each has its own set of tiles.
enum class HopperCutFor { one, gated, several, begins_norm };
/// The Hopper tile with the shortest estimated time. n_column: columns of all products together.
ProductCut cut_for_hopper(MatrixKind kind, std::int64_t n_row, std::int64_t n_column, std::int64_t depth,
                          HopperCutFor what, int n_sm, const CudaWays& ways);
/// Chooses the fastest cut. is_gated: one kernel computes gate and up, which have n_column columns together.
ProductCut cut_product(const CudaLowering& l, MatrixKind kind, std::int64_t n_row, std::int64_t n_column,
                       std::int64_t depth, bool is_gated);

/// The fastest cut of a product that begins a norm; infinitely slow if no kernel does that.
ProductCut cut_to_begin_norm(const CudaLowering& l, std::int64_t n_row, std::int64_t n_column, std::int64_t depth);
/// Estimated microseconds of a product and of the kernel of a norm after it, which adds the product's shares.
double us_with_norm(const ProductCut& cut);

/// The tensor-core plan with the shortest estimated time. n_row: query rows per key head. n_unit: key heads of the
/// whole batch.
AttentionPlan plan_attention(std::int64_t d_head, std::int64_t n_row, std::int64_t n_unit, std::int64_t n_key, int n_sm,
                             bool has_clusters);
/// The same by wgmma, over one segment of keys.
AttentionPlan plan_flash(std::int64_t d_head, std::int64_t n_row, std::int64_t n_unit, std::int64_t n_key, int n_sm,
                         bool has_mask);
AttentionPlan plan_attention(const CudaLowering& l, const AttentionOp& op);

/// FLOP and bytes, see Program::work.
Work work_of(const CudaLowering& l, const CudaOp& op);

}  // namespace vla::lower
