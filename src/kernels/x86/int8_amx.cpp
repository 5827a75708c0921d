// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/int8_loop.h"
#include "kernels/x86/amx_tiles.h"
#include "kernels/x86/vnni_rows.h"

namespace vla::kernels {
namespace {

/// 32 rows by 32 columns: four tiles of sums, two of x and two of the panel. For few rows, where reading weights is the
/// bottleneck, VNNI multiplies instead: a tile takes the time of sixteen rows even for fewer, and codes smaller than a
/// byte must be expanded in memory before a tile can load them.
struct AmxInt8Tile : AmxRounding {
  using Session = AmxSession;
  static constexpr int kRows = kMaxTernaryRows, kColumns = 32, kStep = 768;
  static constexpr int kBlockRows = 288;  // pi0's 560 rows are two blocks, so two threads read its weights together
  static constexpr std::int64_t kBlockKiB = 640;
  static constexpr bool kEven = false, kBeside = true, kSigned = false;
  static constexpr RoundedLayout kLayout = RoundedLayout::tiles;

  template <class Strips, class Between>
  static void multiply(int n_row, const std::byte* x, std::int64_t x_stride, const Strips& strips, std::int64_t depth,
                       std::int32_t* sums, bool add, const Between& between) {
    if (n_row > Few::kRows) return multiply_tiles(n_row, x, x_stride, strips, depth, sums, add, between);
    for (std::int64_t k = 0; k < depth; k += kDepth) between();
    Few::multiply(n_row, x, x_stride, strips, depth, sums, add);
  }

 private:
  using Few = VnniRows<2>;
  static constexpr int kDepth = 64;  // depth of a tile
  static constexpr std::size_t kLine = kColumns * sizeof(std::int32_t), kLineOfPair = 2 * Int8Panels::kLine;

  template <class Packed, class Between>
  static void multiply_tiles(int n_row, const std::byte* x, std::int64_t x_stride,
                             const ExpandedStrips<2, Packed>& strips, std::int64_t depth, std::int32_t* sums, bool add,
                             const Between& between) {
    // Rows after the last of x are multiplied too; their sums are not read.
    KeepVectorUnitPowered vectors;
    open(n_row, sums, add);
    for (std::int64_t k = 0; k < depth; k += kDepth) {
      add_products(n_row, x + k, x_stride, strips.lines + k * kColumns, kLineOfPair, Int8Panels::kLine);
      vectors.keep();
      between();
    }
    close(n_row, sums);
  }

  /// Multiplies by codes smaller than a byte.
  template <class Strips, class Between>
  static void multiply_tiles(int n_row, const std::byte* x, std::int64_t x_stride, const Strips& strips,
                             std::int64_t depth, std::int32_t* sums, bool add, const Between& between) {
    alignas(64) std::byte lines[kDepth * kColumns];
    open(n_row, sums, add);
    for (std::int64_t k = 0; k < depth; k += kDepth) {
      expand<V::Int, 2>(strips, k, kDepth, lines);
      before_tile_loads();
      add_products(n_row, x + k, x_stride, lines, kLineOfPair, Int8Panels::kLine);
      between();
    }
    close(n_row, sums);
  }

  template <class Between>
  static void multiply_tiles(int n_row, const std::byte* x, std::int64_t x_stride, const BytePanels::Strips<2>& strips,
                             std::int64_t depth, std::int32_t* sums, bool add, const Between& between) {
    KeepVectorUnitPowered vectors;
    open(n_row, sums, add);
    for (std::int64_t k = 0; k < depth; k += kDepth) {
      add_products(n_row, x + k, x_stride, strips.strips + k * Int8Panels::kColumns, Int8Panels::kLine, strips.strip);
      vectors.keep();
      between();
    }
    close(n_row, sums);
  }

  static VLA_INLINE void open(int n_row, const std::int32_t* sums, bool add) {
    before_tile_loads();
    if (!add) {
      _tile_zero(0);
      _tile_zero(1);
      _tile_zero(2);
      _tile_zero(3);
      return;
    }
    _tile_loadd(0, sums, kLine);
    _tile_loadd(1, sums + 16, kLine);
    if (n_row <= 16) return;
    _tile_loadd(2, sums + 16 * kColumns, kLine);
    _tile_loadd(3, sums + 16 * kColumns + 16, kLine);
  }

  /// x bypasses L1, where the panel stays. The first operand, x, is signed; the second is unsigned: lines, `line` bytes
  /// apart, of two strips, `strip` bytes apart.
  static VLA_INLINE void add_products(int n_row, const std::byte* x, std::int64_t x_stride, const std::byte* lines,
                                      std::size_t line, std::int64_t strip) {
    _tile_stream_loadd(4, x, static_cast<std::size_t>(x_stride));
    _tile_loadd(6, lines, line);
    _tile_loadd(7, lines + strip, line);
    _tile_dpbsud(0, 4, 6);
    _tile_dpbsud(1, 4, 7);
    if (n_row <= 16) return;
    _tile_stream_loadd(5, x + 16 * x_stride, static_cast<std::size_t>(x_stride));
    _tile_dpbsud(2, 5, 6);
    _tile_dpbsud(3, 5, 7);
  }

  static VLA_INLINE void close(int n_row, std::int32_t* sums) {
    _tile_stored(0, sums, kLine);
    _tile_stored(1, sums + 16, kLine);
    if (n_row > 16) {
      _tile_stored(2, sums + 16 * kColumns, kLine);
      _tile_stored(3, sums + 16 * kColumns + 16, kLine);
    }
    before_tile_loads();  // also keeps loads of the sums after the stores
  }
};

bool supports(const MatrixDesc& desc, Features use) { return !is_float(desc.type) && use.has(Feature::amx_int8); }

}  // namespace

extern const LinearKernel kTernaryAmx, kInt4Amx, kInt8Amx;
const LinearKernel kTernaryAmx = Int8Loop<AmxInt8Tile, TernaryPanels>::kernel("amx_int8", supports);
const LinearKernel kInt4Amx = Int8Loop<AmxInt8Tile, Int4Panels>::kernel("amx_int8", supports);
const LinearKernel kInt8Amx = Int8Loop<AmxInt8Tile, BytePanels>::kernel("amx_int8", supports);

}  // namespace vla::kernels
