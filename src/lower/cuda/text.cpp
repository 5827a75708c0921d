// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <fmt/ranges.h>

#include "lower/cuda/cuda_lowering.h"
#include "lower/words.h"

namespace vla::lower {
namespace {

double size_of(const Value& value) { return static_cast<double>(dtype_size(value.type, count(value.shape))); }

/// Describes an operation: what it computes, and the value that it is computed of.
struct Describe {
  struct Words {
    std::string what;
    ValueId x;
  };

  Words operator()(const HeadOp& op) const { return {words_of(op.rows) + "heads", op.rows.x}; }
  Words operator()(const RoundOp& op) const { return {op.norm != nullptr ? "norm, round" : "round", op.x}; }
  Words operator()(const AttentionOp& op) const { return {words_of(op), op.q.x}; }
  Words operator()(const CopyOp& op) const { return {words_of(op), op.parts[0].from}; }
  Words operator()(const LookupOp& op) const { return {words_of(op), op.ids}; }
  Words operator()(const PatchesOp& op) const { return {words_of(op), op.images}; }
  Words operator()(const ChannelOp& op) const { return {words_of(op), op.q}; }
  template <class OfX>  // LinearOp, RowOp, WindowOp
  Words operator()(const OfX& op) const {
    return {words_of(op), op.x};
  }
};

std::string layout(const CudaLowering& l, ValueId id) {
  const Value& value = l.value(id);
  const char* place = l.base(id).placement == Value::Placement::slot   ? "@slot"
                      : l.base(id).placement == Value::Placement::kept ? "@kept"
                                                                       : "";
  return fmt::format("{}{}{}", dtype_name(value.type), shape_text(value.shape), place);
}

}  // namespace

Work work_of(const CudaLowering& l, const CudaOp& op) {
  Work work;
  for (const ValueId id : op.reads) work.bytes += size_of(l.value(id));
  for (const ValueId id : op.writes) work.bytes += size_of(l.value(id));
  if (op.partial != kNone) work.bytes += size_of(l.value(op.partial));  // read as well
  if (const auto* linear = std::get_if<LinearOp>(&op.op))
    for (const Node* node : linear->linears) {
      const MatrixKind kind = l.matrix(*node).kind;
      const double bits = kind == MatrixKind::ternary ? 2
                          : kind == MatrixKind::int8  ? 8
                          : kind == MatrixKind::bf16  ? 16
                                                      : 32;
      const double flop = flop_of(*node);
      work.flop += flop;
      if (kind == MatrixKind::ternary || kind == MatrixKind::int8) work.int8 += flop;
      work.weights += bits / 8 * static_cast<double>(node->as<op::Linear>()->weight->count());
    }
  if (const auto* attention = std::get_if<AttentionOp>(&op.op)) work.flop += flop_of(*attention->node);
  if (const auto* channels = std::get_if<ChannelOp>(&op.op)) work.flop += flop_of(*channels->node);
  if (const auto* lookup = std::get_if<LookupOp>(&op.op); lookup != nullptr && lookup->table != kNone)
    work.bytes -= size_of(l.value(lookup->table));  // some rows of it alone, as many as there are results
  work.bytes += work.weights;
  return work;
}

std::string text_of(const CudaLowering& l, const CudaOp& op, const Calls& calls) {
  const Describe::Words words = std::visit(Describe(), op.op);
  std::vector<std::string> results;
  for (const ValueId id : op.writes) results.push_back(layout(l, id));
  const Work work = work_of(l, op);
  return fmt::format("{:>4} {:<11} {:>10.2f} {:>9.3f}  {}  {} -> {}\n", op.phase,
                     calls.empty() ? "nothing" : calls.front().how.kernel, 1e-6 * work.flop, 1e-6 * work.bytes,
                     words.what, layout(l, words.x), fmt::join(results, ", "));
}

}  // namespace vla::lower
