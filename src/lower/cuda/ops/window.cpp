// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/window.h"

#include "lower/cuda/emit.h"

namespace vla::lower {

Result<Calls> calls_of(const CudaLowering& l, const CudaOp& op, const WindowOp& at) {
  const Shape &x = l.value(at.x).shape, &places = at.node->shape;
  const Value& y = l.value(op.writes[0]);
  const cuda::WindowJob job = {.x = l.at(at.x),
                               .weight = l.at(at.weight),
                               .bias = l.at(at.bias),
                               .y = l.at(op.writes[0]),
                               .y_stride = y.stride[1],
                               .d = narrow(x[0]),
                               .width = narrow(x[1]),
                               .height = narrow(x[2]),
                               .n_view = narrow(x[3]),
                               .size = at.window.size,
                               .stride = at.window.stride,
                               .padding = at.window.padding,
                               .n_column = narrow(places[1]),
                               .n_row = narrow(places[2]),
                               .takes_largest = at.takes_largest,
                               .is_bf16 = y.type == DType::bf16};
  return Calls{call(cuda::window_elements(job), job)};
}

}  // namespace vla::lower
