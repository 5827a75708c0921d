// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/packing.h"

#include <algorithm>
#include <cstring>

#include "kernels/sizes.h"

namespace vla::lower {
namespace {

/// Rows of a matrix in a part: whole panels of every kernel.
constexpr std::int64_t kPartRows = 64;
/// Bytes of a part, at least.
constexpr std::int64_t kPartSize = 1 << 20;

/// The matrix as it is multiplied.
kernels::MatrixDesc desc_of(const Param& matrix, const Encoding& encoding) {
  return {encoding.type, matrix.shape[0], matrix.shape[1]};
}

/// Scales that the bundle does not have.
std::int64_t n_made_scale(const Param& matrix, const Encoding& encoding) {
  return matrix.scales == nullptr ? encoding.n_scale(matrix.count()) : 0;
}

/// Those of elements from `first` on, where float32 needs them.
std::span<const std::byte> scales_of(const Param& matrix, const Encoding& wanted, std::int64_t first,
                                     std::int64_t count) {
  if (wanted.type == matrix.encoding.type || matrix.scales == nullptr) return {};
  const auto size = [&](std::int64_t n) {
    return static_cast<std::size_t>(matrix.encoding.n_scale(n)) * sizeof(float);
  };
  return matrix.scales->source->data.subspan(size(first), size(count));
}

}  // namespace

std::size_t MatrixPlace::size_of(const Param& param) const {
  return aligned(kernel->packed_size(desc_of(param, encoding))) +
         aligned(static_cast<std::size_t>(n_made_scale(param, encoding)) * sizeof(float));
}

void MatrixPlace::put(const Param& param, std::byte* to) {
  data = to;
  if (n_made_scale(param, encoding) > 0)
    scales = reinterpret_cast<float*>(to + aligned(kernel->packed_size(desc_of(param, encoding))));
}

void add_parts(const Param& matrix, const MatrixPlace& place, std::vector<PackPart>& parts) {
  const std::span<const std::byte> all = matrix.source->data;
  kernels::MatrixDesc desc = desc_of(matrix, place.encoding);
  const std::int64_t n_row = desc.d_out, row = static_cast<std::int64_t>(all.size()) / n_row;
  const std::int64_t step = kernels::round_up(kPartSize / row + 1, kPartRows);
  for (std::int64_t first = 0; first < n_row; first += step) {
    desc.d_out = first;
    std::byte* const to = place.data + place.kernel->packed_size(desc);
    desc.d_out = std::min(step, n_row - first);
    parts.push_back(
        {.from = all.subspan(static_cast<std::size_t>(first * row), static_cast<std::size_t>(desc.d_out * row)),
         .to = to,
         .desc = desc,
         .kernel = place.kernel,
         .recode = {matrix.encoding, place.encoding},
         .scales = place.scales != nullptr ? place.scales + place.encoding.n_scale(first * desc.d_in) : nullptr,
         .from_scales = scales_of(matrix, place.encoding, first * desc.d_in, desc.d_out * desc.d_in)});
  }
}

void Packer::reserve(std::span<const PackPart> parts) {
  for (const PackPart& part : parts) {
    read_.take(Content::room_for(part.from.size()));
    scales_.take(Content::room_for(part.from_scales.size()));
    if (part.recode.changes()) recoded_.take(part.recode.room_for(part.desc.d_in * part.desc.d_out));
  }
}

bool Packer::run(const Content& content, const PackPart& part) {
  const std::byte* read = content.read(part.from, read_);
  const std::byte* scales = content.read(part.from_scales, scales_);
  if (read == nullptr || (scales == nullptr && !part.from_scales.empty())) return false;
  if (part.kernel == nullptr) {
    std::memcpy(part.to, read, part.from.size());
  } else {
    const auto* const from_scales = reinterpret_cast<const float*>(scales);
    const std::int64_t count = part.desc.d_in * part.desc.d_out;
    part.kernel->pack(part.desc, part.recode(read, from_scales, count, recoded_, part.scales), part.to);
  }
  return true;
}

}  // namespace vla::lower
