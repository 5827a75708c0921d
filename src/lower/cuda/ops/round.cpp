// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <cstring>

#include "lower/cuda/emit.h"

namespace vla::lower {
namespace {

/// Launches of a norm that first adds the shares of the product whose result it reads.
Result<Calls> finish_and_norm(const CudaLowering& l, const CudaOp& op, const cuda::NormJob& norm) {
  VLA_TRY(const Calls product, calls_of(l, *op.finishes, std::get<LinearOp>(op.finishes->op)));
  const Call& finish = product.back();
  cuda::FinishNormJob job = {.product = {}, .norm = norm};
  std::memcpy(&job.product, finish.job.data(), sizeof(job.product));
  job.norm.sum = l.at(op.finishes->writes[0]);
  if (is_whole(job)) return Calls{call(cuda::finish_norm_rows(job), job)};
  return Calls{finish, call(cuda::norm_rows(norm), norm)};
}

}  // namespace

cuda::NormJob norm_job(const CudaLowering& l, const CudaOp& op, ValueId id, const Node* node, ValueId weight,
                       ValueId bias) {
  const Value &x = l.value(id), &y = l.value(op.writes[0]);
  cuda::NormJob job = {};
  job.x = l.at(id), job.y = l.at(op.writes[0]), job.x_stride = row_stride(x), job.y_stride = y.stride[1];
  job.n_row = narrow(rows_of(x.shape)), job.n = narrow(x.shape[0]);
  job.weight = l.at(weight), job.bias = l.at(bias);
  if (node == nullptr) return job;
  const auto& norm = *node->as<op::Norm>();
  job.eps = norm.eps, job.norm = norm.kind == op::NormKind::rms ? cuda::RowNorm::rms : cuda::RowNorm::layer;
  return job;
}

Result<Calls> calls_of(const CudaLowering& l, const CudaOp& op, const RoundOp& round) {
  cuda::NormJob job = norm_job(l, op, round.x, round.norm, round.weight, round.bias);
  const DType type = l.value(op.writes[0]).type;
  job.type = type == DType::i8 ? cuda::RowType::codes : type == DType::bf16 ? cuda::RowType::bf16 : cuda::RowType::f32;
  if (op.finishes != nullptr) return finish_and_norm(l, op, job);
  return Calls{call(cuda::norm_rows(job), job)};
}

}  // namespace vla::lower
