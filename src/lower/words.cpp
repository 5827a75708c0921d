// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/words.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

namespace vla::lower {
namespace {

std::string path_of(const Node& node) { return node.path.empty() ? fmt::format("%{}", node.id) : node.path; }

}  // namespace

std::string words_of(const Prepared& rows) {
  return fmt::format("{}{}", rows.norm != nullptr ? "norm " : "", rows.rope != nullptr ? "rope " : "");
}

std::string words_of(const LinearOp& op) {
  std::vector<std::string> names;
  for (const Node* node : op.linears) names.push_back(path_of(*node));
  const char* before = op.norm != nullptr ? "norm, " : op.unfold != nullptr ? "unfold, " : "";
  std::string what = fmt::format("{}linear {}", before, fmt::join(names, " | "));
  if (op.activation != Activation::none) what += fmt::format(", {}", activation_name(op.activation));
  if (op.gated) what += ", gate";
  if (op.factor != kNone) what += ", factor";
  if (op.residual != kNone) what += ", residual";
  if (op.ends_in_relu) what += ", relu";
  return what;
}

std::string words_of(const AttentionOp& op) {
  return fmt::format("{}attention {} over {} keys{}", words_of(op.q), path_of(*op.node), fmt::join(op.n_key, " + "),
                     op.mask != kNone ? ", mask" : "");
}

std::string words_of(const RowOp& op) { return fmt::format("{} {}", op_name(op.node->op), path_of(*op.node)); }

std::string words_of(const CopyOp& op) {
  return fmt::format("copy {} part{}", op.parts.size(), op.parts.size() == 1 ? "" : "s");
}

std::string words_of(const LookupOp& op) { return fmt::format("{} {}", op_name(op.node->op), path_of(*op.node)); }

std::string words_of(const PatchesOp&) { return "patches"; }

std::string words_of(const WindowOp& op) { return op_name(op.node->op); }

std::string words_of(const ChannelOp& op) {
  const int n_group = op.node->as<op::ChannelAttention>()->n_group;
  return fmt::format("{} of {} groups", op_name(op.node->op), n_group);
}

}  // namespace vla::lower
