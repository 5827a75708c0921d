// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <map>
#include <span>

#include "bundle/gguf_writer.h"
#include "bundle/params.h"

namespace vla {

/// Passes the rows of a tensor to `see` as floats, which it may change. A vector counts as a row. Errors: bad_bundle.
Status each_row(const Bundle& bundle, const TensorInfo& tensor,
                const std::function<void(std::int64_t row, std::span<float>)>& see);

/// Appends floats to a tensor of the dtype f32 or bf16.
void put_floats(std::span<const float> values, DType dtype, BundleFile& out);

/// Writes a bundle with the keys and the shapes of another one. `write` puts the elements of each tensor that
/// `is_changed`; the others are copied. Errors: io; those of Bundle::read and of `write`.
Status write_changed(const Bundle& bundle, const std::string& to,
                     const std::function<bool(const TensorInfo&)>& is_changed,
                     const std::function<Status(const TensorInfo&, BundleFile&)>& write);

/// The tensors of parameters, found by their offset in the file, since robots of a bundle share tensors.
class TensorsOfParams {
 public:
  /// `file`: the whole file, with the names of all robots. `opened`: the bundle that owns the parameters. Both must
  /// outlive this.
  TensorsOfParams(const Bundle& file, const Bundle& opened) : opened_(opened) {
    for (const TensorInfo& tensor : file.tensors()) by_offset_[file.offset(tensor.data.data())] = &tensor;
  }
  const TensorInfo& of(const Param* param) const { return *by_offset_.at(opened_.offset(param->source->data.data())); }

 private:
  const Bundle& opened_;
  std::map<std::ptrdiff_t, const TensorInfo*> by_offset_;
};

}  // namespace vla
