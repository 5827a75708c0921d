// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "cuda/kernels/linear_bf16.h"
#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {
namespace {

/// Whether kernels of a product can begin a norm of its result (cuda::LinearBf16Job::norm_begin).
bool can_begin(const CudaLowering& l, const CudaOp& op) {
  const auto* product = std::get_if<LinearOp>(&op.op);
  return product != nullptr && product->linears.size() == 1 && is_of_bf16(l, *product) &&
         op.cut.shape != cuda::Bf16Shape::few && op.rotation.table == kNone && op.begins.squares == kNone &&
         l.value(op.writes[0]).type == DType::f32 && product->activation == Activation::none && !product->ends_in_relu;
}
/// Whether kernels of a product can end the norm of its x, which is `rows` (cuda::LinearBf16Job::norm_end).
bool can_end(const CudaLowering& l, const CudaOp& op, ValueId rows, int n_more) {
  const auto* product = std::get_if<LinearOp>(&op.op);
  if (product == nullptr || product->x != rows || !is_of_bf16(l, *product)) return false;
  const bool has_own = op.cut.tile || strip_width(op.cut.shape) > 0;  // kernels that take more rows of x than of y
  if (n_more == 0) return has_own || op.cut.n_split > 1;
  const std::int64_t most = op.cut.tile ? cuda::kHopperTiles[*op.cut.tile].rows : 64;
  return has_own && rows_of(l.value(rows).shape) + n_more <= most;
}
/// Whether an operation reads a value or a view of it.
bool reads(const CudaLowering& l, const CudaOp& op, ValueId id) {
  return std::ranges::any_of(op.reads, [&](ValueId read) { return l.value(read).base == id; });
}
/// Whether a norm's weight or bias, if there is one, is made before an operation.
bool is_before(CudaLowering& l, ValueId parameter, const CudaOp& op) {
  const CudaOp* const maker = parameter == kNone ? nullptr : maker_of(l, l.value(parameter).base);
  return maker == nullptr || maker->order < op.order;
}
bool is_layer(const RoundOp& norm) { return norm.norm->as<op::Norm>()->kind == op::NormKind::layer; }

/// The product that can begin this norm, if all that read the norm can end it; else null.
CudaOp* beginner_of(CudaLowering& l, const CudaOp& norm, const RoundOp& what) {
  const ValueId rows = norm.writes[0];
  const Value& x = l.value(what.x);
  const bool is_whole = x.base == what.x && x.placement == Value::Placement::arena;
  if (what.norm == nullptr || l.value(rows).type != DType::bf16 || !is_whole) return nullptr;
  CudaOp* const maker = maker_of(l, what.x);
  if (maker == nullptr || !can_begin(l, *maker) || !is_before(l, what.weight, *maker) ||
      !is_before(l, what.bias, *maker))
    return nullptr;
  const int n_more = cuda::rows_of_norm(is_layer(what), what.bias != kNone);
  const auto needs_norm = [&](const CudaOp& op) { return reads(l, op, rows) && !can_end(l, op, rows, n_more); };
  return std::ranges::any_of(l.ops, needs_norm) ? nullptr : maker;
}

/// The norm with values for its moments.
HalvedNorm halved(CudaLowering& l, const CudaOp& norm, const RoundOp& what, const ProductCut& cut) {
  const Shape x = l.value(what.x).shape;
  HalvedNorm made = {.rows = norm.writes[0], .weight = what.weight, .bias = what.bias};
  made.eps = what.norm->as<op::Norm>()->eps;
  made.part = cuda::norm_part(cut.tile ? 64 : strip_width(cut.shape));
  made.n_part = static_cast<int>(ceil_div(x[0], made.part));
  const auto add = [&] { return add_value(l, {rows_of(x), made.n_part, 1, 1}, DType::f32, rows_of(x)); };
  made.squares = add();
  if (is_layer(what)) made.sums = add();
  Value& rows = l.value(made.rows);
  rows.size += dtype_size(DType::bf16, made.n_more() * rows.stride[1]);
  return made;
}

/// Lets a product begin a norm, and the norm's products end it, if the product does not get slower by more time than
/// the norm takes. This shortens a layer's chain by one kernel.
void halve_norm(CudaLowering& l, CudaOp& norm, const RoundOp& what) {
  CudaOp* const maker = beginner_of(l, norm, what);
  if (maker == nullptr) return;
  const Shape x = l.value(what.x).shape;
  const std::int64_t depth = l.value(std::get<LinearOp>(maker->op).x).shape[0];
  const ProductCut cut = cut_to_begin_norm(l, rows_of(x), x[0], depth);
  if (cut.us >= us_with_norm(maker->cut)) return;
  const HalvedNorm made = halved(l, norm, what, cut);
  const std::vector<ValueId> moments = made.moments();
  for (CudaOp& op : l.ops) {
    if (&op == &norm || !reads(l, op, made.rows)) continue;
    op.ends = made;
    op.reads.insert(op.reads.end(), moments.begin(), moments.end());
  }
  maker->cut = cut, maker->begins = made;
  maker->writes.push_back(made.rows);
  maker->writes.insert(maker->writes.end(), moments.begin(), moments.end());
  for (const ValueId parameter : {made.weight, made.bias})
    if (parameter != kNone) maker->reads.push_back(parameter);
  norm.writes.clear();
}

}  // namespace

bool is_of_bf16(const CudaLowering& l, const LinearOp& product) {
  return std::ranges::all_of(product.linears,
                             [&](const Node* node) { return l.matrix(*node).kind == MatrixKind::bf16; });
}

CudaOp* maker_of(CudaLowering& l, ValueId id) {
  const auto makes = [&](const CudaOp& op) { return !op.writes.empty() && op.writes[0] == id; };
  const auto maker = std::ranges::find_if(l.ops, makes);
  return maker != l.ops.end() ? &*maker : nullptr;
}

void halve_norms(CudaLowering& l) {
  if (!l.graph.stages().empty()) return;  // a prefix: computed once, mostly of more rows than fit
  for (CudaOp& op : l.ops)
    if (const auto* round = std::get_if<RoundOp>(&op.op)) halve_norm(l, op, *round);
  std::erase_if(l.ops, [](const CudaOp& op) { return op.writes.empty(); });
}

}  // namespace vla::lower
