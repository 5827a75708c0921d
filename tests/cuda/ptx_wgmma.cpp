// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <cstring>

#include "cuda/fragments.h"
#include "cuda/ptx_warp.h"

namespace vla::test::cuda {

namespace {

/// Takes registers of a product over, unless they are in flight already.
WgmmaRegisters* take(WarpState& w, const PtxInstruction& i, const std::vector<u32>& places) {
  const auto first = w.in_flight.find(places[0]);
  WgmmaRegisters* taken = first == w.in_flight.end() ? nullptr : first->second.first;
  if (taken == nullptr) taken = &w.wgmma_registers.emplace_back();
  taken->of.resize(places.size());
  for (std::size_t r = 0; r < places.size(); ++r) {
    const auto [at, is_new] = w.in_flight.try_emplace(places[r], taken, r);
    if (is_new && taken->n_product == 0) std::memcpy(&taken->of[r], w.lanes<u32>(places[r]), sizeof(Lanes));
    if (at->second != std::pair{taken, r} || (is_new && taken->n_product != 0))
      fault_at(w, i, 0, "registers of different products");
  }
  return taken;
}
void wgmma(WarpState& w, const PtxInstruction& i) {
  WgmmaProduct product = i.product;
  product.a = product.a_in_registers ? 0 : w.lanes<u64>(i.operand[0])[0];
  product.b = w.lanes<u64>(i.operand[1])[0];
  const u32 adds = w.mask(i.operand[2]);
  for (int l = 0; l < kWarp; ++l)
    if ((!product.a_in_registers && w.lanes<u64>(i.operand[0])[l] != product.a) ||
        w.lanes<u64>(i.operand[1])[l] != product.b)
      fault_at(w, i, l, "lanes of a warp issue different products");
  if (adds != 0 && adds != kAll) fault_at(w, i, 0, "lanes of a warp issue different products");
  product.adds = adds != 0;
  for (const u32 place : i.of_a)
    if (w.unfenced.contains(place)) fault_at(w, i, 0, "registers written without wgmma.fence after it");
  WgmmaRegisters* const a = product.a_in_registers ? take(w, i, i.of_a) : nullptr;
  WgmmaRegisters* const sums = take(w, i, i.sums);
  guarded(w, i, 0, [&] { w.wgmma.issue(product, *sums, a); });
}
void wgmma_wait(WarpState& w, const PtxInstruction& i) {
  guarded(w, i, 0, [&] { w.wgmma.wait(w.lanes<u32>(i.operand[0])[0]); });
  for (const auto& [place, taken] : w.in_flight)
    if (taken.first->n_product == 0) std::memcpy(w.lanes<u32>(place), &taken.first->of[taken.second], sizeof(Lanes));
  std::erase_if(w.in_flight, [](const auto& one) { return one.second.first->n_product == 0; });
  std::erase_if(w.wgmma_registers, [](const WgmmaRegisters& one) { return one.n_product == 0; });
}

const PtxOperation kOperations[] = {
    {"wgmma.fence.sync.aligned", "", [](WarpState& w, const PtxInstruction&) { w.wgmma.fence(), w.unfenced.clear(); },
     PtxInstruction::kWarp},
    {"wgmma.commit_group.sync.aligned", "", [](WarpState& w, const PtxInstruction&) { w.wgmma.commit(); },
     PtxInstruction::kWarp},
    {"wgmma.wait_group.sync.aligned", "d", wgmma_wait, PtxInstruction::kWarp},
};
}  // namespace

std::span<const PtxOperation> wgmma_operations() { return kOperations; }

bool renames(WarpState& w, const PtxInstruction& i) {
  const auto found = i.is_move ? w.in_flight.find(i.operand[1]) : w.in_flight.end();
  if (i.is_move) w.in_flight.erase(i.operand[0]);
  if (found != w.in_flight.end()) {
    if (w.active != kAll) fault_at(w, i, 0, "touches registers of wgmma that it has not waited for");
    const auto sum = found->second;
    w.in_flight[i.operand[0]] = sum;
    return true;
  }
  for (int k = 0; k < i.n_operand; ++k)
    if (w.in_flight.contains(i.operand[k])) fault_at(w, i, 0, "touches registers of wgmma that it has not waited for");
  return false;
}

void (*find_wgmma(const std::string& name, WgmmaProduct& product))(WarpState&, const PtxInstruction&) {
  const std::string_view start = "wgmma.mma_async.sync.aligned.m64n";
  if (name.compare(0, start.size(), start) != 0) return nullptr;
  char* end = nullptr;
  product.n = static_cast<int>(std::strtol(name.c_str() + start.size(), &end, 10));
  const std::string_view shape = end;
  if (product.n < 8 || product.n > 256 || product.n % 8 != 0) return nullptr;
  if (shape != "k16.f32.bf16.bf16" && shape != "k32.s32.s8.s8") return nullptr;
  product.kind = shape[1] == '1' ? WgmmaProduct::bf16 : WgmmaProduct::s8;
  return wgmma;
}
}  // namespace vla::test::cuda
