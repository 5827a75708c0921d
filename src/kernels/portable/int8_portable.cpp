// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/int8_loop.h"
#include "kernels/portable/vec_portable.h"

namespace vla::kernels {
namespace {

/// Plain loops, which any compiler can vectorize.
struct PortableTile {
  using V = Portable;
  static constexpr int kRows = 5, kColumns = 32, kBlockRows = 25, kStep = 128;
  static constexpr std::int64_t kBlockKiB = 640;
  static constexpr bool kEven = true, kBeside = false, kSigned = false;
  static constexpr RoundedLayout kLayout = RoundedLayout::none;
  struct Session {};

  template <class Strips, class Between>
  static void multiply(int n_row, const std::byte* x, std::int64_t x_stride, const Strips& panel, std::int64_t depth,
                       std::int32_t* sums, bool add, const Between&) {
    for (int r = 0; r < n_row; ++r)
      for (int n = 0; n < kColumns; ++n) {
        std::int32_t sum = add ? sums[r * kColumns + n] : 0;
        for (std::int64_t k = 0; k < depth; ++k)
          sum += static_cast<signed char>(x[r * x_stride + k]) * number(panel, k, n);
        sums[r * kColumns + n] = sum;
      }
  }

 private:
  /// Element k of column n, read from its aligned group of eight bytes.
  template <class Strips>
  static VLA_INLINE int number(const Strips& panel, std::int64_t k, int n) {
    const int place = n % 16 * 4 + static_cast<int>(k % 4);
    const auto eight = panel.template load<Eight>(k / 16 * 16, static_cast<int>(k % 16 / 4), n / 16, place / 8 * 8);
    return static_cast<BytePanels::Number>(eight[0] >> place % 8 * 8 & 255);
  }
  typedef std::uint64_t Eight __attribute__((vector_size(8)));
};

bool supports(const MatrixDesc& desc, Features) { return !is_float(desc.type); }

}  // namespace

extern const LinearKernel kTernaryPortable, kInt4Portable, kInt8Portable;
const LinearKernel kTernaryPortable = Int8Loop<PortableTile, TernaryPanels>::kernel("portable_int8", supports);
const LinearKernel kInt4Portable = Int8Loop<PortableTile, Int4Panels>::kernel("portable_int8", supports);
const LinearKernel kInt8Portable = Int8Loop<PortableTile, BytePanels>::kernel("portable_int8", supports);

}  // namespace vla::kernels
