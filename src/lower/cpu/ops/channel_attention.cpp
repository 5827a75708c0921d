// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/emit.h"

namespace vla::lower {

/// One item computes one group of one view.
CpuRun run_of(const CpuLowering& l, const CpuOp& op, const ChannelOp& at) {
  static_assert(op::ChannelAttention::kMaxGroup <= kernels::kMaxChannels);
  const Shape& shape = at.node->shape;
  const kernels::ChannelAttentionJob job = {.q = floats(l, at.q),
                                            .k = floats(l, at.k),
                                            .v = floats(l, at.v),
                                            .y = floats(l, op.writes[0]),
                                            .q_stride = row_stride(l.value(at.q)),
                                            .k_stride = row_stride(l.value(at.k)),
                                            .v_stride = row_stride(l.value(at.v)),
                                            .d = shape[0],
                                            .n = shape[1],
                                            .n_view = shape[2],
                                            .n_group = at.n_group};
  const auto run = [job, attend = cpu(l).channel_attention](std::int64_t item, Worker&) { attend(job, item); };
  return {.kernel = name_of(l.use), .kind = KindClock::attention, .scratch = 0, .task = task_of(job.n_unit(), run)};
}

}  // namespace vla::lower
