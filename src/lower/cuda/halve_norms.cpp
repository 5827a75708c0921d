// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "cuda/kernels/linear_bf16.h"
#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {
namespace {

bool is_bf16(const CudaLowering& l, const LinearOp& product) {
  return std::ranges::all_of(product.linears,
                             [&](const Node* node) { return l.matrix(*node).kind == MatrixKind::bf16; });
}
/// Whether kernels of a product can begin a norm of its result (cuda::LinearBf16Job::norm_begin).
bool can_begin(const CudaLowering& l, const CudaOp& op) {
  const auto* product = std::get_if<LinearOp>(&op.op);
  return product != nullptr && product->linears.size() == 1 && is_bf16(l, *product) &&
         op.cut.shape != cuda::Bf16Shape::few && op.rotation.table == kNone && op.begins.squares == kNone &&
         l.value(op.writes[0]).type == DType::f32 && product->activation == Activation::none && !product->ends_in_relu;
}
/// Whether kernels of a product can end the norm of its x, which is `rows` (cuda::LinearBf16Job::norm_end).
bool can_end(const CudaLowering& l, const CudaOp& op, ValueId rows) {
  const auto* product = std::get_if<LinearOp>(&op.op);
  const bool has_kernel = op.cut.tile || strip_width(op.cut.shape) > 0 || op.cut.n_split > 1;
  return product != nullptr && product->x == rows && is_bf16(l, *product) && has_kernel;
}
/// Whether an operation reads a value or a view of it.
bool reads(const CudaLowering& l, const CudaOp& op, ValueId id) {
  return std::ranges::any_of(op.reads, [&](ValueId read) { return l.value(read).base == id; });
}

/// The product that can begin this norm, if all that read the norm can end it; else null.
CudaOp* beginner_of(CudaLowering& l, const CudaOp& norm, const RoundOp& what) {
  const ValueId rows = norm.writes[0];
  const Value& x = l.value(what.x);
  const bool is_whole = x.base == what.x && x.placement == Value::Placement::arena;
  if (what.norm == nullptr || what.bias != kNone || l.value(rows).type != DType::bf16 || !is_whole) return nullptr;
  if (what.norm->as<op::Norm>()->kind != op::NormKind::rms) return nullptr;
  CudaOp* const maker = maker_of(l, what.x);
  const CudaOp* const of_weight = what.weight == kNone ? nullptr : maker_of(l, l.value(what.weight).base);
  if (maker == nullptr || !can_begin(l, *maker) || (of_weight != nullptr && of_weight->order >= maker->order))
    return nullptr;
  const auto needs_norm = [&](const CudaOp& op) { return reads(l, op, rows) && !can_end(l, op, rows); };
  return std::ranges::any_of(l.ops, needs_norm) ? nullptr : maker;
}

/// Lets a product begin a norm, and the norm's products end it, if the product does not get slower by more time than
/// the norm takes. This shortens a layer's chain by one kernel.
void halve_norm(CudaLowering& l, CudaOp& norm, const RoundOp& what) {
  CudaOp* const maker = beginner_of(l, norm, what);
  if (maker == nullptr) return;
  const Shape x = l.value(what.x).shape;
  const std::int64_t n_row = rows_of(x), depth = l.value(std::get<LinearOp>(maker->op).x).shape[0];
  const ProductCut cut = cut_to_begin_norm(l, n_row, x[0], depth);
  if (cut.us >= us_with_norm(maker->cut)) return;
  HalvedNorm halved = {.rows = norm.writes[0], .weight = what.weight, .eps = what.norm->as<op::Norm>()->eps};
  halved.n_part = static_cast<int>(ceil_div(x[0], cuda::norm_part(cut.tile ? 64 : strip_width(cut.shape))));
  halved.squares = add_value(l, {n_row, halved.n_part, 1, 1}, DType::f32, n_row);
  for (CudaOp& op : l.ops)
    if (&op != &norm && reads(l, op, halved.rows)) op.ends = halved, op.reads.push_back(halved.squares);
  maker->cut = cut, maker->begins = halved;
  maker->writes.insert(maker->writes.end(), {halved.rows, halved.squares});
  if (what.weight != kNone) maker->reads.push_back(what.weight);
  norm.writes.clear();
}

}  // namespace

CudaOp* maker_of(CudaLowering& l, ValueId id) {
  const auto makes = [&](const CudaOp& op) { return !op.writes.empty() && op.writes[0] == id; };
  const auto maker = std::ranges::find_if(l.ops, makes);
  return maker != l.ops.end() ? &*maker : nullptr;
}

void halve_norms(CudaLowering& l) {
  for (CudaOp& op : l.ops)
    if (const auto* round = std::get_if<RoundOp>(&op.op)) halve_norm(l, op, *round);
  std::erase_if(l.ops, [](const CudaOp& op) { return op.writes.empty(); });
}

}  // namespace vla::lower
