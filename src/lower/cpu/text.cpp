// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <fmt/ranges.h>

#include "lower/cpu/emit.h"

namespace vla::lower {
namespace {

std::string path_of(const Node& node) { return node.path.empty() ? fmt::format("%{}", node.id) : node.path; }

/// The parts of a fused operation in the order in which they are computed.
struct Describe {
  const CpuLowering& l;
  const CpuOp& fused;

  /// `what [shape] -> [shape] kernel`.
  struct Words {
    std::string what, kernel;
    ValueId x;
  };

  static std::string prepared(const Prepared& rows) {
    return fmt::format("{}{}", rows.norm != nullptr ? "norm " : "", rows.rope != nullptr ? "rope " : "");
  }

  Words operator()(const LinearOp& op) const {
    std::vector<std::string> names;
    for (const Node* node : op.linears) names.push_back(path_of(*node));
    const char* before = op.norm != nullptr ? "norm, " : op.unfold != nullptr ? "unfold, " : "";
    std::string what = fmt::format("{}linear {}", before, fmt::join(names, " | "));
    if (op.activation != Activation::none) what += fmt::format(", {}", activation_name(op.activation));
    if (op.gated) what += ", gate";
    if (op.factor != kNone) what += ", factor";
    if (op.residual != kNone) what += ", residual";
    if (op.ends_in_relu) what += ", relu";
    return {what, kernel_of(l, op).name, op.x};
  }
  Words operator()(const QuantizeOp& op) const {
    return {fmt::format("{}quantize", op.norm != nullptr ? "norm, " : ""), op.kernel->name, op.x};
  }
  Words operator()(const PackOp& op) const {
    return {prepared(op.k) + "pack keys and values", name_of(l.features(op.rounds)), op.k.x};
  }
  Words operator()(const AttentionOp& op) const {
    return {fmt::format("{}attention {} over {} keys{}", prepared(op.q), path_of(*op.node), fmt::join(op.n_key, " + "),
                        op.mask != kNone ? ", mask" : ""),
            name_of(l.features(op.rounds)), op.q.x};
  }
  Words operator()(const RowOp& op) const {
    return {fmt::format("{} {}", op_name(op.node->op), path_of(*op.node)), name_of(l.use), op.x};
  }
  Words operator()(const CopyOp& op) const {
    return {fmt::format("copy {} part{}", op.parts.size(), op.parts.size() == 1 ? "" : "s"), "copy", op.parts[0].from};
  }
  Words operator()(const LookupOp& op) const {
    return {fmt::format("{} {}", op_name(op.node->op), path_of(*op.node)), "copy", op.ids};
  }
  Words operator()(const PatchesOp& op) const { return {"patches", "copy", op.images}; }
  Words operator()(const WindowOp& op) const {
    return {op_name(op.node->op), op.takes_largest ? name_of(l.use) : "copy", op.x};
  }
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

}  // namespace vla::lower
