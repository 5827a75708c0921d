// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/wgmma.h"

#include <bit>
#include <cstring>
#include <string>

#include "cuda/fault.h"
#include "cuda/fragments.h"

namespace vla::test::cuda {
namespace {

constexpr std::size_t kChunk = 16;       // bytes that swizzling moves together
constexpr std::size_t kDepthBytes = 32;  // of a product

/// An operand in shared memory, as its matrix descriptor says: rows of 128 or 32 bytes, which are swizzled. A
/// transposed one has a row for each element of the depth. Source: PTX ISA 9.0, "Strides"; the canonical layouts in
/// CUTLASS, include/cute/atom/mma_traits_sm90_gmma.hpp, and include/types/shared/descriptor.cuh of ThunderKittens say
/// the same.
class Operand {
 public:
  explicit Operand(std::uint64_t descriptor, bool transposed = false, int n = 0)
      : first_(field(descriptor, 0)),
        next_(field(descriptor, 16)),
        stride_(field(descriptor, 32)),
        is_transposed_(transposed) {
    constexpr std::uint64_t kKnown = 0xc000'3fff'3fff'3fff;
    const std::uint64_t swizzling = descriptor >> 62;
    if ((descriptor & ~kKnown) != 0) throw Fault("a matrix descriptor with bits that are not known");
    if (swizzling != 1 && swizzling != 3) throw Fault("a matrix descriptor without swizzling over 128 or 32 bytes");
    row_ = swizzling == 1 ? 128 : 32;
    if (!transposed) return;
    if (first_ % (8 * row_) != 0) throw Fault("a transposed matrix that begins between eight rows");
    if (static_cast<std::size_t>(n) % (row_ / 2) != 0) throw Fault("a transposed matrix with a part of a row");
  }
  /// Offset of 16 bytes of a row; those of a transposed matrix go on in rows further on.
  std::size_t chunk(int row, int which) const {
    const auto r = static_cast<std::size_t>(row), at = static_cast<std::size_t>(which) * kChunk;
    const std::size_t of_row = first_ + r / 8 * stride_ + r % 8 * row_;
    const std::size_t plain = is_transposed_ ? of_row + at / row_ * next_ + at % row_ : of_row + at;
    return plain ^ (plain >> 7 & (row_ / kChunk - 1)) << 4;
  }

 private:
  static std::size_t field(std::uint64_t descriptor, int bit) { return (descriptor >> bit & 0x3fff) << 4; }

  std::size_t first_, next_, stride_, row_ = 0;
  bool is_transposed_;
};

/// The bytes of a row of operand a in registers, as mma_bf16 and mma_s8 take it (fragments.h).
void row_of_registers(const WgmmaRegisters& a, int row, std::uint8_t (&to)[kDepthBytes]) {
  for (std::size_t at = 0; at < kDepthBytes; at += 4) {
    const auto r = static_cast<std::size_t>(row);
    std::memcpy(to + at, &a.of[r / 8 + at / 16 * 2][r % 8 * 4 + at % 16 / 4], 4);
  }
}

}  // namespace

void Wgmma::begin(SharedMemory& shared, int warp) {
  *this = {};
  shared_ = &shared, warp_ = warp;
}

void Wgmma::issue(const WgmmaProduct& product, WgmmaRegisters& sums, WgmmaRegisters* a) {
  if (sums.n_product == 0 && !is_fenced_) throw Fault("wgmma without wgmma.fence before it");
  ++n_issued_, ++sums.n_product, ++counts.mma;
  if (a != nullptr) ++a->n_product;
  const Product one = {product, &sums, a};
  read(one);
  if (!schedule.late_copies) compute(one);
  open_.push_back(one);
}

void Wgmma::commit() {
  committed_.push_back(std::move(open_));
  open_.clear(), ++n_group_;
}

void Wgmma::wait(std::size_t n_left) {
  for (; committed_.size() > n_left; committed_.pop_front(), ++n_done_) {
    for (const Product& product : committed_.front()) {
      if (schedule.late_copies) compute(product);
      if (product.in_registers != nullptr) --product.in_registers->n_product;
      if (--product.sums->n_product == 0) is_fenced_ = false;  // other instructions may touch these sums
    }
    shared_->async_done(warp_, n_done_);
  }
}

void Wgmma::end() const {
  if (!is_idle()) throw Fault("ends while wgmma is under way");
}

/// Notes what a product reads, so that nobody writes it before the product was waited for.
void Wgmma::read(const Product& product) const {
  const auto read = [&](const Operand& from, int first, int end, int n_chunk) {
    for (int row = first; row < end; ++row)
      for (int which = 0; which < n_chunk; ++which) shared_->async_read(from.chunk(row, which), warp_, n_group_);
  };
  constexpr int kChunks = kDepthBytes / kChunk;
  if (!product.a_in_registers) read(Operand(product.a), warp_ % 4 * 16, warp_ % 4 * 16 + 16, kChunks);
  const Operand b(product.b, product.b_transposed, product.n);
  product.b_transposed ? read(b, 0, product.depth(), product.n / 8) : read(b, 0, product.n, kChunks);
}

/// As mma_bf16 and mma_s8 (fragments.h): products are exact, and added in float32 one after the other, or exactly.
template <int kDepth>
void Wgmma::compute(const Product& product) const {
  constexpr bool kIsBf16 = kDepth == 16;
  using Eight [[gnu::vector_size(32)]] = float;  // one number of each of eight rows
  const auto numbers = [](const std::uint8_t(&bytes)[kDepthBytes], float(&to)[kDepth]) {
    for (int k = 0; k < kDepth; ++k) {
      std::uint16_t half = 0;
      if (kIsBf16) std::memcpy(&half, bytes + 2 * k, 2);
      to[k] = kIsBf16 ? bf16_to_float(half) : static_cast<float>(static_cast<std::int8_t>(bytes[k]));
    }
  };
  std::uint8_t bytes[kDepthBytes];
  const auto load = [&](const Operand& from, int row, float(&to)[kDepth]) {
    for (int which = 0; which < 2; ++which)
      std::memcpy(bytes + which * 16, shared_->data() + from.chunk(row, which), kChunk);
    numbers(bytes, to);
  };
  const auto load_column = [&](const Operand& from, int column, float(&to)[kDepth]) {
    for (int k = 0; k < kDepth; ++k) {
      std::uint16_t half = 0;
      std::memcpy(&half, shared_->data() + from.chunk(k, column / 8) + column % 8 * 2, 2);
      to[k] = bf16_to_float(half);
    }
  };
  Eight rows[kDepth][2];
  float one[kDepth];
  for (int row = 0; row < 16; ++row) {
    if (product.a_in_registers)
      row_of_registers(*product.in_registers, row, bytes), numbers(bytes, one);
    else
      load(Operand(product.a), warp_ % 4 * 16 + row, one);
    for (int k = 0; k < kDepth; ++k) rows[k][row / 8][row % 8] = one[k];
  }
  const Operand b(product.b, product.b_transposed, product.n);
  for (int column = 0; column < product.n; ++column) {
    product.b_transposed ? load_column(b, column, one) : load(b, column, one);
    Eight sum[2] = {};
    std::uint32_t* to[16];
    for (int row = 0; row < 16; ++row) {
      // Register 4 j + 2 h + c of lane l is row l / 4 + 8 h, column 8 j + 2 (l % 4) + c.
      const auto lane = static_cast<std::size_t>(row % 8 * 4 + column % 8 / 2);
      to[row] = &product.sums->of[static_cast<std::size_t>(column / 8 * 4 + row / 8 * 2 + column % 2)][lane];
      if (!product.adds) *to[row] = 0;
      if (kIsBf16) sum[row / 8][row % 8] = std::bit_cast<float>(*to[row]);
    }
    for (int k = 0; k < kDepth; ++k) sum[0] += rows[k][0] * one[k], sum[1] += rows[k][1] * one[k];
    for (int row = 0; row < 16; ++row) {
      const float of_row = sum[row / 8][row % 8];  // of codes below 2^20, thus exact
      *to[row] = kIsBf16 ? std::bit_cast<std::uint32_t>(of_row)
                         : *to[row] + static_cast<std::uint32_t>(static_cast<std::int32_t>(of_row));
    }
  }
}
void Wgmma::compute(const Product& product) const {
  if (product.kind == WgmmaProduct::bf16)
    compute<16>(product);
  else
    compute<32>(product);
}

void check_warpgroups(const std::vector<const Wgmma*>& warps) {
  for (std::size_t i = 0; i < warps.size(); ++i)
    if (warps[i]->n_issued() != warps[i / 4 * 4]->n_issued() ||
        (warps[i]->n_issued() != 0 && warps.size() < i / 4 * 4 + 4))
      throw Fault("a part of a warpgroup issues wgmma");
}

}  // namespace vla::test::cuda
