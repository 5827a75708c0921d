// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <cmath>

#include "lower/cpu/emit.h"

namespace vla::lower {
namespace {

kernels::RowPrep prep_of(const CpuLowering& l, const HeadRows& rows) {
  kernels::RowPrep prep;
  if (rows.norm != nullptr) {
    const auto& norm = *rows.norm->as<op::Norm>();
    prep.norm = norm_kernel(l, norm), prep.weight = floats(l, rows.weight), prep.eps = norm.eps;
  }
  if (rows.rope != nullptr) prep.rotate = cpu(l).rotate_half, prep.table = floats(l, rows.table);
  return prep;
}

/// Describes x of shape [d_head, n_head, n_token, n_batch] for the kernel.
kernels::HeadRows head_rows(const CpuLowering& l, ValueId id) {
  const Value &x = l.value(id), &base = l.base(id);
  return {.data = l.address(x.base),
          .first = x.offset,
          .head = x.stride[1],
          .token = x.stride[2],
          .batch = x.stride[3],
          .layout = rounded(x),
          .d = base.shape[0]};
}

}  // namespace

kernels::PackJob pack_sizes(const CpuLowering& l, const PackOp& op) {
  const Shape& k = l.value(op.k.x).shape;
  kernels::PackJob job = {};
  job.d_head = k[0], job.n_head_kv = k[1], job.n_key = k[2], job.n_batch = k[3];
  return job;
}

CpuRun run_of(const CpuLowering& l, const CpuOp& op, const PackOp& pack) {
  const kernels::AttentionKernel& kernel = attention_kernel(l, pack.rounds);
  kernels::PackJob job = pack_sizes(l, pack);
  job.k = head_rows(l, pack.k.x), job.v = head_rows(l, pack.v), job.prep = prep_of(l, pack.k);
  job.packed = address(l, op.writes[0]);
  return {
      .kernel = name_of(l.features(pack.rounds)),
      .kind = KindClock::attention,
      .scratch = 0,
      .task = task_of(kernel.n_pack(job), [job, run = kernel.pack](std::int64_t item, Worker&) { run(job, item); })};
}

CpuRun run_of(const CpuLowering& l, const CpuOp& op, const AttentionOp& attention) {
  const kernels::AttentionKernel& kernel = attention_kernel(l, attention.rounds);
  const Value &q = l.value(attention.q.x), &y = l.value(op.writes[0]);
  kernels::AttentionJob job = {};
  job.d_head = q.shape[0], job.n_head = q.shape[1], job.n_query = q.shape[2], job.n_batch = q.shape[3];
  job.n_head_kv = attention.node->in.back().dim(1);
  job.scale = 1.0f / std::sqrt(static_cast<float>(job.d_head));
  job.q = head_rows(l, attention.q.x), job.prep = prep_of(l, attention.q), job.mask = floats(l, attention.mask);
  for (std::size_t i = 0; i < attention.packed.size(); ++i) {
    job.segment[job.n_segment++] = {address(l, attention.packed[i]), attention.n_key[i], job.n_key};
    job.n_key += attention.n_key[i];
  }
  job.out = address(l, op.writes[0]), job.out_layout = rounded(y);
  const std::int64_t n_item = kernel.cut(job, threads_for(l, attention.flop()));
  return {.kernel = name_of(l.features(attention.rounds)),
          .kind = KindClock::attention,
          .scratch = 0,
          .task = task_of(n_item, [job, run = kernel.run](std::int64_t item, Worker&) { run(job, item); })};
}

}  // namespace vla::lower
