// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/channel_attention.h"

#include "lower/cuda/emit.h"

namespace vla::lower {

Result<Calls> calls_of(const CudaLowering& l, const CudaOp& op, const ChannelOp& at) {
  static_assert(op::ChannelAttention::kMaxGroup <= cuda::kMaxChannels);
  const Shape& x = at.node->shape;
  const cuda::ChannelAttentionJob job = {.q = l.at(at.q),
                                         .k = l.at(at.k),
                                         .v = l.at(at.v),
                                         .y = l.at(op.writes[0]),
                                         .q_stride = row_stride(l.value(at.q)),
                                         .k_stride = row_stride(l.value(at.k)),
                                         .v_stride = row_stride(l.value(at.v)),
                                         .d = narrow(x[0]),
                                         .n = narrow(x[1]),
                                         .n_view = narrow(x[2]),
                                         .n_group = at.n_group};
  return Calls{call(cuda::channel_attention(job), job)};
}

}  // namespace vla::lower
