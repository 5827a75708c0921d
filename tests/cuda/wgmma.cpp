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

/// An operand in shared memory, as its matrix descriptor says.
class Operand {
 public:
  explicit Operand(std::uint64_t descriptor)
      : first_((descriptor & 0x3fff) << 4), stride_((descriptor >> 32 & 0x3fff) << 4) {
    constexpr std::uint64_t kKnown = 0xc000'3fff'3fff'3fff;
    if ((descriptor & ~kKnown) != 0) throw Fault("a matrix descriptor with bits that are not known");
    if (descriptor >> 62 != 1) throw Fault("a matrix descriptor without swizzling over 128 bytes");
  }
  /// Offset of 16 bytes of a row.
  std::size_t chunk(int row, int which) const {
    const auto r = static_cast<std::size_t>(row);
    const std::size_t plain = first_ + r / 8 * stride_ + r % 8 * 128 + static_cast<std::size_t>(which) * kChunk;
    return plain ^ (plain >> 7 & 7) << 4;
  }

 private:
  std::size_t first_, stride_;
};

}  // namespace

void Wgmma::begin(SharedMemory& shared, int warp) {
  *this = {};
  shared_ = &shared, warp_ = warp;
}

void Wgmma::issue(const WgmmaProduct& product, WgmmaSums& sums) {
  if (sums.n_product == 0 && !is_fenced_) throw Fault("wgmma without wgmma.fence before it");
  ++n_issued_, ++sums.n_product, ++counts.mma;
  const Product one = {product, &sums};
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
      --product.sums->n_product;
    }
    shared_->async_done(warp_, n_done_);
  }
  if (is_idle()) is_fenced_ = false;  // sums are free for other instructions
}

void Wgmma::end() const {
  if (!is_idle()) throw Fault("ends while wgmma is under way");
}

/// Notes what a product reads, so that nobody writes it before the product was waited for.
void Wgmma::read(const Product& product) const {
  const Operand a(product.a), b(product.b);
  for (int which = 0; which < static_cast<int>(kDepthBytes / kChunk); ++which) {
    for (int row = 0; row < 16; ++row) shared_->async_read(a.chunk(warp_ % 4 * 16 + row, which), warp_, n_group_);
    for (int row = 0; row < product.n; ++row) shared_->async_read(b.chunk(row, which), warp_, n_group_);
  }
}

/// As mma_bf16 and mma_s8 (fragments.h): products are exact, and added in float32 one after the other, or exactly.
template <int kDepth>
void Wgmma::compute(const Product& product) const {
  constexpr bool kIsBf16 = kDepth == 16;
  using Eight [[gnu::vector_size(32)]] = float;  // one number of each of eight rows
  const auto load = [&](const Operand& from, int row, float(&to)[kDepth]) {
    std::uint8_t bytes[kDepthBytes];
    for (int which = 0; which < 2; ++which)
      std::memcpy(bytes + which * 16, shared_->data() + from.chunk(row, which), kChunk);
    for (int k = 0; k < kDepth; ++k) {
      std::uint16_t half = 0;
      if (kIsBf16) std::memcpy(&half, bytes + 2 * k, 2);
      to[k] = kIsBf16 ? bf16_to_float(half) : static_cast<float>(static_cast<std::int8_t>(bytes[k]));
    }
  };
  const Operand a(product.a), b(product.b);
  Eight rows[kDepth][2];
  float one[kDepth];
  for (int row = 0; row < 16; ++row) {
    load(a, warp_ % 4 * 16 + row, one);
    for (int k = 0; k < kDepth; ++k) rows[k][row / 8][row % 8] = one[k];
  }
  for (int column = 0; column < product.n; ++column) {
    load(b, column, one);
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
