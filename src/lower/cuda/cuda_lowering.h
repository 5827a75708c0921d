// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>

#include "lower/cuda/cuda_device.h"
#include "lower/lowering.h"

/// The passes of a GPU: what its kernels need to lie contiguously, and a launch for each operation.
namespace vla::lower {

/// Rows of heads, normed and turned, for attention.
struct HeadOp {
  Prepared rows;
};

struct CudaOp : Step {
  std::variant<LinearOp, HeadOp, AttentionOp, RowOp, CopyOp, LookupOp, PatchesOp> op;
  ValueId gate = kNone;                                // of a gated product, what its first matrix makes
  std::vector<std::pair<ValueId, ValueId>> keys = {};  // of attention, keys and values of each segment
};

struct CudaLowering : Lowering {
  const std::vector<cuda::Address>& params;  // by Param::id
  std::vector<CudaOp> ops = {};
  std::vector<cuda::Address> data = {};  // of each base, when memory is there

  cuda::Address address(ValueId id) const {
    const Value& v = value(id);
    return data[static_cast<std::size_t>(v.base)] + static_cast<cuda::Address>(v.offset) * 4;
  }
  float* floats(ValueId id) const { return id == kNone ? nullptr : reinterpret_cast<float*>(address(id)); }
  cuda::Address param(const Param* of) const { return of == nullptr ? 0 : params[static_cast<std::size_t>(of->id)]; }
};

/// Has operations read what their kernels can: copies what lies otherwise, and norms and turns heads before attention,
/// which takes keys and values where they lie.
void choose_layouts(CudaLowering& l, std::vector<FusedOp> ops);

/// One launch, or several one after the other.
using Call = std::function<Status(cuda::Stream&)>;
/// Errors: unsupported for sizes that no kernel has.
Result<std::vector<Call>> emit(const CudaLowering& l, const CudaOp& op);

}  // namespace vla::lower
