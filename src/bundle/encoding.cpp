// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bundle/encoding.h"

namespace vla {

const char* dtype_name(DType type) {
  constexpr const char* kNames[] = {"f32", "f16", "bf16", "i32", "i8", "f64", "ternary", "int4"};
  return kNames[static_cast<int>(type)];
}

int dtype_bits(DType type) {
  constexpr int kBits[] = {32, 16, 16, 32, 8, 64, 2, 4};
  return kBits[static_cast<int>(type)];
}

void widen_codes(const Encoding& encoding, const std::byte* codes, const float* scales, std::int64_t n, float* to) {
  const std::size_t row_size = dtype_size(encoding.type, encoding.group);
  for (std::int64_t begin = 0; begin < n; begin += encoding.group, codes += row_size, ++scales) {
    const auto* blocks = reinterpret_cast<const Int4Block*>(codes);
    for (std::int64_t k = 0; k < encoding.group; ++k) {
      const int code = encoding.type == DType::int4 ? blocks[k / Int4Block::kElements][k % Int4Block::kElements]
                                                    : std::to_integer<std::int8_t>(codes[k]);
      to[begin + k] = static_cast<float>(code) * *scales;
    }
  }
}

}  // namespace vla
