// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/emit.h"

#include <fmt/format.h>

#include <algorithm>

#include "kernels/sizes.h"

namespace vla::lower {
namespace {

/// FLOP below which a product takes less time than waking a thread.
constexpr double kMinSharedFlop = 2e6;
/// Elements per item of an operation that is not a product.
constexpr std::int64_t kItemElements = 16384;

}  // namespace

RowItems::RowItems(const CpuLowering& l, std::int64_t n, std::int64_t d) : n_row(n) {
  const std::int64_t wanted = l.n_thread == 1 ? 1 : std::min<std::int64_t>(n * d / kItemElements, 8 * l.n_thread);
  n_each = kernels::ceil_div(n, std::max<std::int64_t>(1, wanted));
  n_item = kernels::ceil_div(n, n_each);
}

kernels::LinearJob::Norm norm_of(const CpuLowering& l, const Node* node, ValueId weight, ValueId bias) {
  if (node == nullptr) return {};
  const auto& norm = *node->as<op::Norm>();
  return {norm_kernel(l, norm), floats(l, weight), floats(l, bias), norm.eps};
}

kernels::Window window_of(const Shape& x, const op::Window& window, const Shape& y) {
  return {.d = x[0],
          .width = x[1],
          .height = x[2],
          .size = window.size,
          .stride = window.stride,
          .padding = window.padding,
          .n_column = y[1],
          .n_row = y[2]};
}

int threads_for(const CpuLowering& l, double flop) { return flop < kMinSharedFlop ? 1 : l.n_thread; }

std::string text_of(const CpuLowering& l, const CpuOp& op, const CpuRun& run) {
  const std::string what = std::visit([](const auto& of) { return of.text(); }, op.op);
  const auto* blocked = std::get_if<BlockedOp>(&op.op);
  if (blocked == nullptr) return line_of(l, op, run.kernel, what, work_of(l, op));
  std::string lines;
  for (CpuOp product : blocked->products) {
    const auto& linear = std::get<LinearOp>(product.op);
    product.phase = op.phase;
    const char* kernel = kernel_of(l, *linear.linears[0]).name;
    lines += fmt::format("{}{}, {} blocks of rows", lines.empty() ? "" : "\n",
                         line_of(l, product, kernel, linear.text(), work_of(l, product)), blocked->n_block);
  }
  return lines;
}

/// Drops the numbers that identify one instance of an operation: the phase at the start of a line, a layer number after
/// a dot, and a value's id after %.
std::string likeness_of(std::string_view text) {
  std::string likeness;
  bool in_place = true;  // digits here are dropped
  for (const char c : text) {
    if (in_place && (c == ' ' || (c >= '0' && c <= '9'))) continue;
    likeness += c;
    in_place = c == '.' || c == '%' || c == '\n';
  }
  return likeness;
}

Work work_of(const CpuLowering& l, const CpuOp& op) {
  Work work;
  if (const auto* blocked = std::get_if<BlockedOp>(&op.op)) {
    for (const CpuOp& product : blocked->products) work += work_of(l, product);
    return work;
  }
  work.flop = std::visit([](const auto& what) { return what.flop(); }, op.op);
  const auto add = [&](ValueId id) {
    const Value& value = l.value(id);
    const std::size_t size = value.node != nullptr ? dtype_size(value.type, count(value.shape)) : value.size;
    work.bytes += static_cast<double>(size);
  };
  const auto* lookup = std::get_if<LookupOp>(&op.op);
  // Only the looked-up rows of a table are read.
  for (const ValueId id : op.reads) add(lookup != nullptr && id == lookup->table ? op.writes[0] : id);
  for (const ValueId id : op.writes) add(id);
  if (const auto* linear = std::get_if<LinearOp>(&op.op)) {
    for (const Node* node : linear->linears) {
      const auto& product = *node->as<op::Linear>();
      work.weights += static_cast<double>(l.weights.encoding(product.weight).size(product.weight->count()));
      if (product.bias != nullptr) work.weights += 4.0 * static_cast<double>(product.bias->shape[0]);
    }
    work.bytes += work.weights;
    if (kernel_of(l, *linear->linears[0]).quantize != nullptr) work.int8 = work.flop;
  }
  return work;
}

}  // namespace vla::lower
