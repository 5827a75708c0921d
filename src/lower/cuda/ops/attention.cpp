// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/hopper_flash.h"

#include <cmath>

#include "lower/cuda/emit.h"

namespace vla::lower {

namespace {

/// Errors: device.
Result<Call> flash_call(const CudaLowering& l, const cuda::FlashShape& shape, const cuda::AttentionJob& attention) {
  cuda::FlashJob job = {.k = {}, .v = {}, .attention = attention};
  if (l.gpu != nullptr) {
    VLA_CHECK(l.gpu->map_heads(mapped_heads(shape, attention, attention.segment[0].k), job.k));
    VLA_CHECK(l.gpu->map_heads(mapped_heads(shape, attention, attention.segment[0].v), job.v));
  }
  return call(cuda::hopper_flash(shape, attention), job);
}

}  // namespace

Result<Calls> calls_of(const CudaLowering& l, const CudaOp& op, const AttentionOp& attention) {
  const Value& q = l.value(attention.q.x);
  const std::size_t n_segment = attention.n_key.size();
  if (q.shape[0] > cuda::kMaxHead) return unsupported("attention", "heads of at most", cuda::kMaxHead, q.shape[0]);
  if (n_segment > static_cast<std::size_t>(cuda::AttentionJob::kMaxSegment))
    return unsupported("attention", "segments of keys: at most", cuda::AttentionJob::kMaxSegment,
                       static_cast<std::int64_t>(n_segment));
  cuda::AttentionJob job = {};
  const auto rows = [&](ValueId id) {
    const Shape& stride = l.value(id).stride;
    return cuda::HeadRows{l.at<void>(id), stride[1], stride[2], stride[3]};
  };
  job.q = rows(attention.q.x);
  for (std::size_t i = 0; i < n_segment; ++i)
    job.segment[job.n_segment++] = {rows(attention.packed[2 * i]), rows(attention.packed[2 * i + 1]),
                                    narrow(attention.n_key[i])};
  job.mask = l.at(attention.mask), job.y = l.at(op.writes[0]);
  job.scale = 1 / std::sqrt(static_cast<float>(q.shape[0]));
  job.d_head = narrow(q.shape[0]), job.n_head = narrow(q.shape[1]), job.n_query = narrow(q.shape[2]);
  job.n_batch = narrow(q.shape[3]), job.n_head_kv = narrow(l.value(attention.packed[0]).shape[1]);
  job.n_split = op.plan.n_split, job.partial = l.at(op.partial),
  job.is_bf16 = l.value(op.writes[0]).type == DType::bf16;
  Calls calls;
  if (op.plan.flash != nullptr) {
    VLA_TRY(Call made, flash_call(l, *op.plan.flash, job));
    calls.push_back(std::move(made));
  } else {
    const bool rounds = attention.rounds;
    calls.push_back(call(rounds ? cuda::attention_bf16(*op.plan.shape, job) : cuda::attention_f32(job), job));
  }
  if (job.partial != nullptr) calls.push_back(call(cuda::finish_attention(job), job));
  return calls;
}

}  // namespace vla::lower
