// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/host/packing.h"

#include <doctest/doctest.h>

#include <cstring>

namespace packing_test {

using namespace vla;
using namespace vla::lower;

namespace {

constexpr std::int64_t kDepth = 16384, kRows = 500;  // several parts, the last of them smaller

std::size_t size(const kernels::MatrixDesc& desc) { return dtype_size(desc.type, desc.d_in * desc.d_out); }
void copy(const kernels::MatrixDesc& desc, const std::byte* stored, std::byte* packed) {
  std::memcpy(packed, stored, size(desc));
}

/// A matrix of codes with its scales, and what lies in memory of it.
struct Codes {
  std::vector<std::byte> bytes;
  std::vector<float> stored_scales;
  TensorInfo tensor, scales_tensor;
  Param matrix, scales;

  Codes(DType type, std::vector<float> stored) : stored_scales(std::move(stored)) {
    bytes.resize(dtype_size(type, kDepth * kRows));
    for (std::size_t i = 0; i < bytes.size(); ++i) bytes[i] = static_cast<std::byte>(i * 7 % 127);
    tensor.data = bytes, scales_tensor.data = std::as_bytes(std::span(stored_scales));
    scales.source = &scales_tensor, matrix.source = &tensor, matrix.scales = &scales;
    matrix.shape = {kDepth, kRows};
    matrix.encoding = {type, kDepth * kRows / static_cast<std::int64_t>(stored_scales.size())};
  }

  /// The scales that lie behind the packed matrix.
  std::vector<float> packed_scales() const {
    MatrixPlace place = {.encoding = matrix.encoding, .packing = {size, copy}, .n_scale = kRows};
    ReadBuffer buffer;
    place.put(matrix, buffer.take(place.size_of(matrix)));
    std::vector<PackPart> parts;
    add_parts(matrix, place, parts);
    CHECK(parts.size() > 1);
    Packer packer;
    const Content content(bytes);
    for (const PackPart& part : parts) REQUIRE(packer.run(content, part));
    CHECK(std::memcmp(place.data, bytes.data(), bytes.size()) == 0);
    return {place.scales, place.scales + kRows};
  }
};

}  // namespace

TEST_CASE("a matrix of codes is packed in parts, with a scale a row behind it") {
  std::vector<float> by_row;
  for (std::int64_t row = 0; row < kRows; ++row) by_row.push_back(0.5f + static_cast<float>(row));
  CHECK(Codes(DType::i8, by_row).packed_scales() == by_row);
  CHECK(Codes(DType::ternary, {0.25f}).packed_scales() == std::vector<float>(kRows, 0.25f));
}

}  // namespace packing_test
