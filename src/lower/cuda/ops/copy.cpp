// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/emit.h"

namespace vla::lower {

Result<Calls> calls_of(const CudaLowering& l, const CudaOp& op, const CopyOp& copy) {
  Calls calls;
  cuda::MapJobs jobs = {};
  const auto launch = [&] {
    if (jobs.n == 1) calls.push_back(call(cuda::map_elements(jobs.job[0]), jobs.job[0]));
    if (jobs.n <= 1) return;
    const cuda::Launch how = cuda::map_parts(jobs);  // fills in where each part ends
    calls.push_back(call(how, jobs));
  };
  for (const CopyOp::Part& part : copy.parts) {
    const cuda::MapJob job = map_job(part.shape, l.at(part.from) + part.from_offset, part.from_stride,
                                     l.at(op.writes[0]) + part.to_offset, part.to_stride);
    if (job.count() > 0) jobs.job[jobs.n++] = job;
    if (jobs.n == static_cast<int>(std::size(jobs.job))) launch(), jobs = {};
  }
  launch();
  return calls;
}

}  // namespace vla::lower
