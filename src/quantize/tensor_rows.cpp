// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/tensor_rows.h"

#include <algorithm>

#include "base/bf16.h"
#include "base/file.h"
#include "kernels/numbers.h"
#include "quantize/code_maker.h"

namespace vla {

Status each_row(const Bundle& bundle, const TensorInfo& tensor,
                const std::function<void(std::int64_t row, std::span<float>)>& see) {
  const std::int64_t d = tensor.shape.front(), n_row = tensor.count() / d;
  const std::size_t row_size = dtype_size(tensor.type, d);
  ReadBuffer buffer;
  std::vector<float> values(static_cast<std::size_t>(d));
  for (std::int64_t first = 0; first < n_row; first += kPartRows) {
    const std::int64_t n = std::min(kPartRows, n_row - first);
    VLA_TRY(const auto part, bundle.read(tensor.data.subspan(static_cast<std::size_t>(first) * row_size,
                                                             static_cast<std::size_t>(n) * row_size),
                                         buffer));
    for (std::int64_t i = 0; i < n; ++i) {
      for (std::int64_t k = 0; k < d; ++k)
        values[static_cast<std::size_t>(k)] = kernels::stored_number(tensor.type, part.data(), i * d + k);
      see(first + i, values);
    }
  }
  return {};
}

void put_floats(std::span<const float> values, DType dtype, BundleFile& out) {
  if (dtype == DType::f32) return out.put(std::as_bytes(values));
  std::vector<std::uint16_t> rounded(values.size());
  std::ranges::transform(values, rounded.begin(), [](float value) { return to_bf16(value); });
  out.put(std::as_bytes(std::span(rounded)));
}

Status write_changed(const Bundle& bundle, const std::string& to,
                     const std::function<bool(const TensorInfo&)>& is_changed,
                     const std::function<Status(const TensorInfo&, BundleFile&)>& write) {
  Keys keys = bundle.keys();
  keys.set("vla.checksum", std::string(kNoChecksum));
  const auto write_all = [&](BundleFile& out) -> Status {
    for (const TensorInfo& tensor : bundle.tensors()) {
      if (is_changed(tensor)) {
        VLA_CHECK(write(tensor, out));
        out.end_tensor();
      } else {
        VLA_CHECK(out.copy(bundle, tensor, [](std::size_t) {}));
      }
    }
    return {};
  };
  Status made;
  VLA_CHECK(write_file(to, [&](int file) {
    BundleFile out(file, keys, bundle.tensors());
    made = write_all(out);
    return made && out.seal();
  }));
  return made;
}

}  // namespace vla
