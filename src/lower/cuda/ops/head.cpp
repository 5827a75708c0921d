// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/attention.h"
#include "lower/cuda/emit.h"

namespace vla::lower {

Result<Calls> head_calls(const CudaLowering& l, const CudaOp& op, const HeadRows& rows) {
  const Value& x = l.value(rows.x);
  if (x.shape[0] > cuda::kMaxHead) return unsupported("heads", "heads of at most", cuda::kMaxHead, x.shape[0]);
  const auto* norm = rows.norm != nullptr ? rows.norm->as<op::Norm>() : nullptr;
  const Shape to = contiguous_strides(x.shape);
  const cuda::HeadJob job = {.x = l.at(rows.x),
                             .y = l.at(op.writes[0]),
                             .weight = l.at(rows.weight),
                             .table = l.at(rows.table),
                             .x_head = x.stride[1],
                             .x_token = x.stride[2],
                             .x_batch = x.stride[3],
                             .y_head = to[1],
                             .y_token = to[2],
                             .y_batch = to[3],
                             .d_head = narrow(x.shape[0]),
                             .n_head = narrow(x.shape[1]),
                             .n_token = narrow(x.shape[2]),
                             .n_batch = narrow(x.shape[3]),
                             .eps = norm != nullptr ? norm->eps : 0,
                             .is_bf16 = l.value(op.writes[0]).type == DType::bf16};
  return Calls{call(cuda::head_rows(job), job)};
}

Result<Calls> calls_of(const CudaLowering& l, const CudaOp& op, const HeadOp& head) {
  if (head.rows.norm != nullptr && head.rows.norm->as<op::Norm>()->kind != op::NormKind::rms)
    return Error{Code::unsupported, "heads", "an RMS norm", "a layer norm", "use --kernels ggml"};
  return head_calls(l, op, head.rows);
}

}  // namespace vla::lower
