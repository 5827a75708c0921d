// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/emit.h"

namespace vla::lower {

Result<Calls> calls_of(const CudaLowering& l, const CudaOp& op, const CopyOp& copy) {
  Calls calls;
  for (const CopyOp::Part& part : copy.parts) {
    const cuda::MapJob job = map_job(part.shape, l.at(part.from) + part.from_offset, part.from_stride,
                                     l.at(op.writes[0]) + part.to_offset, part.to_stride);
    if (job.count() > 0) calls.push_back(call(cuda::map_elements(job), job));
  }
  return calls;
}

}  // namespace vla::lower
