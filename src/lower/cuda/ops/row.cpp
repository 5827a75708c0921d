// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/emit.h"

namespace vla::lower {
namespace {

struct RowLaunch {
  const CudaLowering& l;
  const CudaOp& op;
  const RowOp& row;

  Result<Calls> operator()(const op::Norm&) const {
    const cuda::NormJob job = norm_job(l, op, row.x, row.node, row.w, row.b);
    return Calls{call(cuda::norm_rows(job), job)};
  }
  Result<Calls> operator()(const op::Rope&) const { return head_calls(l, op, {.x = row.x, .table = row.w}); }
  Result<Calls> operator()(const op::Activate& activate) const {
    cuda::MapJob job = map();
    job.activation = activate.activation;
    return Calls{call(cuda::map_elements(job), job)};
  }
  Result<Calls> operator()(const op::Scale& scale) const {
    cuda::MapJob job = map();
    job.factor = scale.factor;
    return Calls{call(cuda::map_elements(job), job)};
  }
  Result<Calls> operator()(const op::Add&) const { return with_other(cuda::MapOperation::add); }
  Result<Calls> operator()(const op::Multiply&) const { return with_other(cuda::MapOperation::multiply); }

 private:
  Result<Calls> with_other(cuda::MapOperation operation) const {
    cuda::MapJob job = map();
    job.operation = operation, job.b = l.at(row.w);
    std::ranges::copy(repeated_strides(l.value(row.w)), job.b_step);
    return Calls{call(cuda::map_elements(job), job)};
  }
  cuda::MapJob map() const {
    const Shape& shape = row.node->shape;
    return map_job(shape, l.at(row.x), l.value(row.x).stride, l.at(op.writes[0]), contiguous_strides(shape));
  }
};

}  // namespace

Result<Calls> calls_of(const CudaLowering& l, const CudaOp& op, const RowOp& row) {
  return std::visit(RowLaunch{l, op, row}, row.what);
}

}  // namespace vla::lower
