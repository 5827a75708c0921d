// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/host/packing.h"

#include <algorithm>
#include <cstring>

#include "kernels/sizes.h"

namespace vla::lower {
namespace {

/// Rows per part, a multiple of every kernel's panel.
constexpr std::int64_t kPartRows = 64;
/// Minimum bytes of a part.
constexpr std::int64_t kPartSize = 1 << 20;

/// The matrix's dtype in memory and its sizes.
kernels::MatrixDesc desc_of(const Param& matrix, const Encoding& encoding) {
  return {encoding.type, matrix.shape[0], matrix.shape[1]};
}

/// The bundle's scales for `count` elements from `first` on, if float32 is made from them or they are stored after the
/// packed matrix; else empty.
std::span<const std::byte> scales_of(const Param& matrix, const MatrixPlace& place, std::int64_t first,
                                     std::int64_t count) {
  const Encoding& stored = matrix.encoding;
  if (matrix.scales == nullptr || (stored.type == place.encoding.type && place.scales == nullptr)) return {};
  const std::int64_t begin = first / stored.group, end = (first + count - 1) / stored.group + 1;
  return matrix.scales->source->data.subspan(static_cast<std::size_t>(begin) * sizeof(float),
                                             static_cast<std::size_t>(end - begin) * sizeof(float));
}

/// Writes one scale per row, repeating the bundle's if it has one for the whole matrix.
void copy_scales(const float* from, std::size_t n_from, std::int64_t n_row, float* to) {
  for (std::int64_t row = 0; row < n_row; ++row) to[row] = from[n_from > 1 ? row : 0];
}

}  // namespace

std::size_t MatrixPlace::scales_begin(const Param& param) const {
  return aligned(packing.size(desc_of(param, encoding)));
}

std::size_t MatrixPlace::size_of(const Param& param) const {
  return scales_begin(param) + aligned(static_cast<std::size_t>(n_scale) * sizeof(float));
}

void MatrixPlace::put(const Param& param, std::byte* to) {
  data = to;
  if (n_scale > 0) scales = reinterpret_cast<float*>(to + scales_begin(param));
}

void add_parts(const Param& matrix, const MatrixPlace& place, std::vector<PackPart>& parts) {
  const std::span<const std::byte> all = matrix.source->data;
  kernels::MatrixDesc desc = desc_of(matrix, place.encoding);
  const std::int64_t n_row = desc.d_out, row = static_cast<std::int64_t>(all.size()) / n_row;
  const std::int64_t step = kernels::round_up(kPartSize / row + 1, kPartRows);
  for (std::int64_t first = 0; first < n_row; first += step) {
    desc.d_out = first;
    std::byte* const to = place.data + place.packing.size(desc);
    desc.d_out = std::min(step, n_row - first);
    parts.push_back(
        {.from = all.subspan(static_cast<std::size_t>(first * row), static_cast<std::size_t>(desc.d_out * row)),
         .to = to,
         .desc = desc,
         .pack = place.packing.pack,
         .recode = {matrix.encoding, place.encoding},
         .scales = place.scales != nullptr ? place.scales + first : nullptr,
         .from_scales = scales_of(matrix, place, first * desc.d_in, desc.d_out * desc.d_in)});
  }
}

void Packer::reserve(std::span<const PackPart> parts) {
  for (const PackPart& part : parts) {
    read_.take(Content::buffer_size(part.from.size()));
    scales_.take(Content::buffer_size(part.from_scales.size()));
    if (part.recode.changes()) recoded_.take(part.recode.buffer_size(part.desc.d_in * part.desc.d_out));
  }
}

bool Packer::run(const Content& content, const PackPart& part) {
  const std::byte* read = content.read(part.from, read_);
  const std::byte* scales = content.read(part.from_scales, scales_);
  if (read == nullptr || (scales == nullptr && !part.from_scales.empty())) return false;
  if (part.pack == nullptr) {
    std::memcpy(part.to, read, part.from.size());
    return true;
  }
  const auto* const from_scales = reinterpret_cast<const float*>(scales);
  const std::int64_t count = part.desc.d_in * part.desc.d_out;
  part.pack(part.desc, part.recode(read, from_scales, count, recoded_, part.scales), part.to);
  if (part.scales != nullptr && scales != nullptr)
    copy_scales(from_scales, part.from_scales.size() / sizeof(float), part.desc.d_out, part.scales);
  return true;
}

}  // namespace vla::lower
