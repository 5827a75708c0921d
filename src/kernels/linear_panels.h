// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/linear_kernel.h"
#include "kernels/numbers.h"
#include "kernels/sizes.h"

/// Memory layout of a packed matrix.
///
/// A *panel* holds some columns of the product (rows of W) over the whole depth (d_in), as consecutive blocks of 1 KiB.
/// A block has 16 columns, stored in lines across them: a line of 64 bytes holds two consecutive bf16 or one f32 of
/// every column, a line of 32 bytes one f16. A block is therefore 32 deep, or 16 for f32. Panels of 32 columns
/// alternate between blocks of their two halves. Missing columns, and the depth up to a multiple of 32, are zeros.
///
/// AMX tiles load whole blocks; vector kernels load lines.
namespace vla::kernels {

constexpr std::int64_t kPanelBlock = 1024, kPanelDepth = 32;

/// Copies n elements of a row of x, padded with zeros to a multiple of kPanelDepth.
template <class X>
VLA_INLINE void copy_padded(const X* from, std::int64_t n, X* to) {
  std::memcpy(to, from, static_cast<std::size_t>(n) * sizeof(X));
  for (std::int64_t i = n; i % kPanelDepth != 0; ++i) to[i] = 0;
}

/// Panels of kColumns, 16 or 32.
template <int kColumns>
struct Panels {
  static_assert(kColumns == 16 || kColumns == 32);

  /// Bytes of a panel for a depth that is a multiple of 32.
  static VLA_INLINE std::int64_t size(DType type, std::int64_t depth) { return depth * kColumns * number_size(type); }

  // Functions of a LinearKernel.
  static std::size_t packed_size(const MatrixDesc& desc);
  static void pack(const MatrixDesc& desc, const std::byte* stored, std::byte* packed);

  /// Element k of column n of a panel.
  static VLA_INLINE float number(DType type, const std::byte* panel, std::int64_t k, std::int64_t n) {
    return stored_number(type, panel + place(type, k, n), 0);
  }

 private:
  static constexpr std::int64_t block_depth(DType type) { return type == DType::f32 ? 16 : 32; }

  /// Offset of element k of column n.
  static VLA_INLINE std::int64_t place(DType type, std::int64_t k, std::int64_t n) {
    const std::int64_t depth = block_depth(type), inner = k % depth, column = n % 16;
    const std::int64_t block = (k / depth * (kColumns / 16) + n / 16) * kPanelBlock;
    if (type == DType::bf16) return block + inner / 2 * 64 + column * 4 + inner % 2 * 2;
    return block + (inner * 16 + column) * number_size(type);
  }
};

}  // namespace vla::kernels
