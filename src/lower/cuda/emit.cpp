// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/emit.h"

namespace vla::lower {
namespace {

double size_of(const Value& value) { return static_cast<double>(dtype_size(value.type, count(value.shape))); }

double bits_of(MatrixKind kind) {
  if (is_of_codes(kind)) return cuda::column_bytes(code_kind(kind)) * 8.0 / cuda::Int8Tile::kDepth;
  return kind == MatrixKind::bf16 ? 16 : 32;
}

}  // namespace

Error unsupported(const char* what, const char* more, std::int64_t most, std::int64_t found) {
  return {Code::unsupported, what, more + (" " + std::to_string(most)), std::to_string(found), "use --kernels ggml"};
}

Work work_of(const CudaLowering& l, const CudaOp& op) {
  Work work;
  work.flop = std::visit([](const auto& what) { return what.flop(); }, op.op);
  for (const ValueId id : op.reads) work.bytes += size_of(l.value(id));
  for (const ValueId id : op.writes) work.bytes += size_of(l.value(id));
  if (op.partial != kNone) work.bytes += size_of(l.value(op.partial));  // sums are written, then read
  if (const auto* linear = std::get_if<LinearOp>(&op.op))
    for (const Node* node : linear->linears) {
      const MatrixKind kind = l.matrix(*node).kind;
      if (is_of_codes(kind)) work.int8 += flop_of(*node);
      work.weights += bits_of(kind) / 8 * static_cast<double>(node->as<op::Linear>()->weight->count());
    }
  if (const auto* lookup = std::get_if<LookupOp>(&op.op); lookup != nullptr && lookup->table != kNone)
    work.bytes -= size_of(l.value(lookup->table));  // a lookup does not read the whole table
  work.bytes += work.weights;
  return work;
}

}  // namespace vla::lower
