// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <fmt/ranges.h>

#include "lower/cpu/emit.h"
#include "lower/words.h"

namespace vla::lower {
namespace {

/// The parts of a fused operation in the order in which they are computed.
struct Describe {
  const CpuLowering& l;
  const CpuOp& fused;

  /// `what [shape] -> [shape] kernel`.
  struct Words {
    std::string what, kernel;
    ValueId x;
  };

  Words operator()(const LinearOp& op) const { return {words_of(op), kernel_of(l, op).name, op.x}; }
  Words operator()(const QuantizeOp& op) const {
    return {fmt::format("{}quantize", op.norm != nullptr ? "norm, " : ""), op.kernel->name, op.x};
  }
  Words operator()(const PackOp& op) const {
    return {words_of(op.k) + "pack keys and values", name_of(l.features(op.rounds)), op.k.x};
  }
  Words operator()(const AttentionOp& op) const { return {words_of(op), name_of(l.features(op.rounds)), op.q.x}; }
  Words operator()(const RowOp& op) const { return {words_of(op), name_of(l.use), op.x}; }
  Words operator()(const CopyOp& op) const { return {words_of(op), "copy", op.parts[0].from}; }
  Words operator()(const LookupOp& op) const { return {words_of(op), "copy", op.ids}; }
  Words operator()(const PatchesOp& op) const { return {words_of(op), "copy", op.images}; }
  Words operator()(const WindowOp& op) const {
    return {words_of(op), op.takes_largest || op.weight != kNone ? name_of(l.use) : "copy", op.x};
  }
  Words operator()(const ChannelOp& op) const { return {words_of(op), name_of(l.use), op.q}; }
  Words operator()(const BlockedOp&) const { return {}; }  // its products are described
};

std::string layout(const CpuLowering& l, ValueId id) {
  const Value& value = l.value(id);
  const char* place = l.base(id).placement == Value::Placement::slot     ? "@slot"
                      : l.base(id).placement == Value::Placement::kept   ? "@kept"
                      : l.base(id).placement == Value::Placement::thread ? "@thread"
                                                                         : "";
  if (value.node == nullptr && value.size > 0 && value.stride == Shape{1, 1, 1, 1})
    return fmt::format("panels{}", place);
  return fmt::format("{}{}{}{}", dtype_name(value.type),
                     rounded(value) == kernels::RoundedLayout::tiles ? " tiles " : "", shape_text(value.shape), place);
}

}  // namespace

std::string text_of(const CpuLowering& l, const CpuOp& op) {
  if (const auto* blocked = std::get_if<BlockedOp>(&op.op)) {
    std::vector<std::string> lines;
    for (CpuOp product : blocked->products) {
      product.phase = op.phase;
      lines.push_back(fmt::format("{}, {} blocks of rows", text_of(l, product), blocked->n_block));
    }
    return fmt::format("{}", fmt::join(lines, "\n"));
  }
  const auto words = std::visit(Describe{l, op}, op.op);
  std::vector<std::string> results;
  for (const ValueId id : op.writes) results.push_back(layout(l, id));
  const Work work = work_of(l, op);
  return fmt::format("{:>4} {:<11} {:>10.2f} {:>9.3f}  {}  {} -> {}", op.phase, words.kernel, 1e-6 * work.flop,
                     1e-6 * work.bytes, words.what, layout(l, words.x), fmt::join(results, ", "));
}

/// The phase stands in front, the number of a block behind a dot, that of a value behind %.
std::string likeness_of(std::string_view text) {
  std::string likeness;
  bool in_place = true;  // numbers are left out
  for (const char c : text) {
    if (in_place && (c == ' ' || (c >= '0' && c <= '9'))) continue;
    likeness += c;
    in_place = c == '.' || c == '%' || c == '\n';
  }
  return likeness;
}

}  // namespace vla::lower
