// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "cuda/device_memory.h"
#include "cuda/emulation.h"
#include "cuda/shared_memory.h"

/// PTX as nvcc writes it, run a warp at a time: an instruction is done for all lanes of a warp before the next one is
/// looked at. Where lanes part, those that are least far in the text go on first, until they meet again. What is not
/// known is refused by name when the text is read. Source: PTX ISA 9.0.
namespace vla::test::cuda {

struct WarpState;

/// One instruction. Operands are places in a warp's registers, which hold 32 lanes each: of 4 bytes, of 8, or one mask
/// of 4 bytes where the register is a predicate.
struct PtxInstruction {
  enum Kind { kPlain, kBranch, kReturn, kBarrier, kCluster, kWarp } kind = kPlain;  // kWarp: all lanes together
  void (*run)(WarpState&, const PtxInstruction&) = nullptr;
  std::uint32_t operand[16] = {};
  int n_operand = 0;
  std::uint32_t guard = 0;
  bool has_guard = false, guard_is_not = false;
  int target = -1;
  // Loads, stores and copies.
  std::int64_t offset[2] = {};
  int width = 0, count = 1;
  bool sign = false, wide_address = false, wide_value = false;  // registers of 8 bytes
  mutable DeviceMemory::Allocation* hint = nullptr;             // where the last access went
  mutable std::uint64_t hint_time = 0;
  std::vector<std::uint32_t> sums;  // of wgmma
  std::vector<std::uint32_t> of_a;  // of wgmma whose operand a is in registers
  bool makes_operand = false;       // writes such a register
  WgmmaProduct product;
  bool is_move = false;
  std::string text;
};

struct PtxKernel {
  std::string name;
  std::vector<PtxInstruction> code;
  std::size_t register_bytes = 0, param_size = 0, static_shared = 0;
  int max_thread = 1024;
  bool overlaps = false;             // begins while earlier kernels end, and waits for them
  std::vector<std::byte> constants;  // how the registers begin: constants stand first
  struct Special {
    std::uint32_t place;
    int which;  // of kSpecials
  };
  std::vector<Special> specials;
  struct SharedAddress {
    std::uint32_t place;
    bool wide;
  };
  std::vector<SharedAddress> dynamic_shared;  // registers that hold the address of what the launch gives
};

class PtxModule {
 public:
  explicit PtxModule(const std::string& text);
  const PtxKernel* find(const std::string& name) const;

 private:
  std::map<std::string, PtxKernel> kernels_;
};

/// Runs all clusters, one after the other, and the blocks of a cluster in turns. Throws Fault.
void run_ptx(const PtxKernel& kernel, Extent grid, unsigned n_thread, std::size_t shared, const void* job);

// Between ptx_parse.cpp and the files of instructions: ptx_instructions.cpp, ptx_memory.cpp, ptx_wgmma.cpp.

constexpr const char* kSpecials[] = {"%tid.x",    "%ctaid.x",  "%ctaid.y",  "%ctaid.z", "%ntid.x",
                                     "%nctaid.x", "%nctaid.y", "%nctaid.z", "%laneid"};

/// An operation of a table: its operands' types in order, d for 4 bytes (also of 16-bit numbers), q for 8, p for a
/// predicate, s and g for addresses in shared and global memory, _ where there is no result.
struct PtxOperation {
  const char* name;
  const char* operands;
  void (*run)(WarpState&, const PtxInstruction&);
  PtxInstruction::Kind kind = PtxInstruction::kPlain;
};
/// The tables of ptx_memory.cpp and ptx_wgmma.cpp.
std::span<const PtxOperation> memory_operations();
std::span<const PtxOperation> wgmma_operations();
/// From any table; null for others.
const PtxOperation* find_operation(const std::string& name);
/// The product of a wgmma, and what runs it; null for others.
void (*find_wgmma(const std::string& name, WgmmaProduct& product))(WarpState&, const PtxInstruction&);
/// What copies a box of a tensor map of so many dimensions, to this block or also to others; null for others.
void (*find_box_copy(const std::string& name, int& n_dimension, bool& has_mask))(WarpState&, const PtxInstruction&);
/// Loads (ld) and stores (st) of param, shared and global, and loads of shared::cluster; null for others.
void (*find_access(const std::string& operation, const std::string& space))(WarpState&, const PtxInstruction&);

}  // namespace vla::test::cuda
