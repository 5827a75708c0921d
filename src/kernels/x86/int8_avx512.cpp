// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/int8_loop.h"
#include "kernels/x86/vnni_rows.h"

namespace vla::kernels {
namespace {

/// 6 rows by 4 vectors: 24 sums.
template <int kDepth>
struct VnniTile {
  using V = Avx512;
  using Rows = VnniRows<4>;
  static constexpr int kRows = Rows::kRows, kColumns = Rows::kColumns, kBlockRows = 216, kStep = kDepth;
  static constexpr std::int64_t kBlockKiB = 1600;
  static constexpr bool kEven = true, kBeside = false, kSigned = false;
  static constexpr RoundedLayout kLayout = RoundedLayout::none;
  static constexpr bool kFirstExpands = true;
  struct Session {};

  template <class Strips, class Between>
  static void multiply(int n_row, const std::byte* x, std::int64_t x_stride, const Strips& strips, std::int64_t depth,
                       std::int32_t* sums, bool add, const Between&) {
    Rows::multiply(n_row, x, x_stride, strips, depth, sums, add);
  }
};

bool supports(const MatrixDesc& desc, Features use) { return !is_float(desc.type) && use.has(Feature::avx512_vnni); }

}  // namespace

extern const LinearKernel kTernaryAvx512, kInt4Avx512, kInt8Avx512;
const LinearKernel kTernaryAvx512 = Int8Loop<VnniTile<2560>, TernaryPanels>::kernel("avx512_int8", supports);
const LinearKernel kInt4Avx512 = Int8Loop<VnniTile<2560>, Int4Panels>::kernel("avx512_int8", supports);
const LinearKernel kInt8Avx512 = Int8Loop<VnniTile<512>, BytePanels>::kernel("avx512_int8", supports);

}  // namespace vla::kernels
