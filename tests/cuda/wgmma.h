// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <deque>
#include <vector>

#include "cuda/emulation.h"
#include "cuda/shared_memory.h"

namespace vla::test::cuda {

/// Registers of a warp that products which were issued use, sums or operand a: each register, lane by lane.
struct WgmmaRegisters {
  std::vector<std::array<std::uint32_t, kWarp>> of;
  int n_product = 0;  // that have not been waited for
};

/// The products of a warp, which has 16 of its warpgroup's 64 rows. Operands are read when a product is issued or as
/// late as it is waited for, as schedule.late_copies says; both are a GPU's. Until then its registers are nobody's to
/// touch. Source: PTX ISA 9.0, "Asynchronous Warpgroup Level Matrix Multiply-Accumulate Instructions".
class Wgmma {
 public:
  void begin(SharedMemory& shared, int warp);
  void fence() { is_fenced_ = true; }
  /// `sums`, and `a` if that is in registers, must stay where they are until they have no product.
  void issue(const WgmmaProduct& product, WgmmaRegisters& sums, WgmmaRegisters* a);
  void commit();
  void wait(std::size_t n_left);
  /// A Fault where a product was not waited for.
  void end() const;
  long n_issued() const { return n_issued_; }

 private:
  struct Product : WgmmaProduct {
    WgmmaRegisters *sums, *in_registers;
  };
  void read(const Product& product) const;
  template <int kDepth>
  void compute(const Product& product) const;
  void compute(const Product& product) const;
  bool is_idle() const { return open_.empty() && committed_.empty(); }

  SharedMemory* shared_ = nullptr;
  int warp_ = 0;
  bool is_fenced_ = false;
  long n_issued_ = 0;
  std::uint32_t n_group_ = 0, n_done_ = 0;
  std::vector<Product> open_;
  std::deque<std::vector<Product>> committed_;
};

/// A Fault unless the four warps of each warpgroup issued as many products.
void check_warpgroups(const std::vector<const Wgmma*>& warps);

}  // namespace vla::test::cuda
