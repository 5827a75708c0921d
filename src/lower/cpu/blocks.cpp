// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <map>

#include "kernels/sizes.h"
#include "lower/cpu/cpu_lowering.h"

namespace vla::lower {
namespace {

/// Fewest rows of a block. Each block reads all weights; with fewer rows, reading them would take longer than
/// multiplying.
constexpr std::int64_t kMinBlockRows = 128;

/// Returns how many blocks of rows keep `x` in the L2 cache between the product that writes it and the one that reads
/// it; 0 if x fits without blocks, or if the blocks would have too few rows.
std::int64_t n_block_of(const CpuLowering& l, const Value& x, const kernels::LinearKernel& reader) {
  if (rounded(x) != kernels::RoundedLayout::tiles) return 0;
  const std::int64_t d = kernels::round_up(x.shape[0], kernels::kTileSide), n_row = rows_of(x.shape);
  const std::int64_t max_rows = reader.l2_elements / d / kernels::kTileSide * kernels::kTileSide;
  if (max_rows < kMinBlockRows || n_row * d <= 2 * reader.l2_elements) return 0;
  const std::int64_t n_block = kernels::round_up(kernels::ceil_div(n_row, max_rows), l.n_thread);
  return n_row / n_block >= kMinBlockRows ? n_block : 0;
}

/// Lists the operations that read each base.
std::map<ValueId, std::vector<CpuOp*>> readers_of(CpuLowering& l) {
  std::map<ValueId, std::vector<CpuOp*>> readers;
  for (CpuOp& op : l.ops)
    for (const ValueId id : op.reads) readers[l.value(id).base].push_back(&op);
  return readers;
}

/// Moves product `up` into the blocks of `down`, the only reader of its result, and leaves `up` without results.
void join(CpuLowering& l, CpuOp& up, CpuOp& down, std::int64_t n_block, std::vector<const Param*> matrices) {
  const ValueId inner = up.writes[0];
  l.value(inner).placement = Value::Placement::thread;
  CpuOp both;
  both.reads = up.reads, both.writes = down.writes, both.matrices = std::move(matrices), both.order = down.order;
  std::ranges::copy_if(down.reads, std::back_inserter(both.reads), [&](ValueId id) { return id != inner; });
  BlockedOp blocked = {{}, n_block};
  blocked.products.push_back(std::move(up));
  blocked.products.push_back(std::move(down));
  both.op = std::move(blocked);
  down = std::move(both);
}

}  // namespace

void choose_blocks(CpuLowering& l) {
  const auto readers = readers_of(l);
  for (CpuOp& up : l.ops) {
    const auto* made = std::get_if<LinearOp>(&up.op);
    if (made == nullptr || made->unfold != nullptr || up.writes.size() != 1) continue;
    const ValueId inner = up.writes[0];
    const auto found = readers.find(inner);
    if (found == readers.end() || found->second.size() != 1) continue;
    CpuOp& down = *found->second[0];
    const auto* reader = std::get_if<LinearOp>(&down.op);
    if (reader == nullptr || reader->x != inner || l.value(inner).placement != Value::Placement::arena) continue;
    std::vector<const Param*> matrices = up.matrices;
    matrices.insert(matrices.end(), down.matrices.begin(), down.matrices.end());
    if (!share_group(l, matrices)) continue;
    if (const std::int64_t n_block = n_block_of(l, l.value(inner), kernel_of(l, *reader->linears[0])))
      join(l, up, down, n_block, std::move(matrices));
  }
  std::erase_if(l.ops, [](const CpuOp& op) { return op.writes.empty(); });
}

}  // namespace vla::lower
