// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/emit.h"

namespace vla::lower {

Result<Calls> calls_of(const CudaLowering& l, const CudaOp& op, const LookupOp& lookup) {
  const Shape& shape = lookup.node->shape;
  cuda::LookupJob job = {};
  job.ids = l.at<std::int32_t>(lookup.ids), job.y = l.at(op.writes[0]);
  job.n = narrow(shape[0]), job.n_row = narrow(shape[1]);
  if (const auto* embedding = lookup.node->as<op::Embedding>()) {
    const DType type = embedding->table->encoding.type;
    job.table = l.param<void>(embedding->table), job.n_table = narrow(embedding->table->shape[1]);
    job.type = type == DType::f32   ? cuda::TableType::f32
               : type == DType::f16 ? cuda::TableType::f16
                                    : cuda::TableType::bf16;
  } else {
    job.table = l.at(lookup.table), job.n_table = narrow(l.value(lookup.table).shape[1]);
  }
  return Calls{call(cuda::lookup_rows(job), job)};
}

}  // namespace vla::lower
