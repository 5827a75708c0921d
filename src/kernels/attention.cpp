// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/attention.h"

#include <cmath>

#include "kernels/cpu_kernels.h"
#include "kernels/custom.h"

namespace vla::kernels {
namespace {

AttentionJob::Rows rows(const ggml_tensor* x) {
  const auto floats = [&](int i) { return static_cast<std::int64_t>(x->nb[i] / sizeof(float)); };
  return {values(x), floats(1), floats(2), floats(3)};
}

/// Sizes and places of keys and values; what remains depends on the operation.
AttentionJob make_job(const ggml_tensor* k, const ggml_tensor* v) {
  AttentionJob job = {};
  job.d_head = k->ne[0];
  job.n_head_kv = k->ne[1];
  job.n_key = k->ne[2];
  job.n_batch = k->ne[3];
  job.k = rows(k);
  job.v = rows(v);
  return job;
}

AttentionJob make_job(const ggml_tensor* q, const ggml_tensor* k, const ggml_tensor* v) {
  AttentionJob job = make_job(k, v);
  job.n_head = q->ne[1];
  job.n_query = q->ne[2];
  job.scale = 1.0f / std::sqrt(static_cast<float>(q->ne[0]));
  job.q = rows(q);
  return job;
}

double bytes(Tensor x) { return static_cast<double>(ggml_nbytes(x.node())); }

/// What a node keeps.
struct AttentionNode {
  const AttentionKernel* kernel;
  Turns turns;
};

void pack_task(ggml_tensor* packed, int ith, int nth, void* kernel) {
  AttentionJob job = make_job(packed->src[0], packed->src[1]);
  job.packed = static_cast<float*>(packed->data);
  static_cast<const AttentionKernel*>(kernel)->pack(job, ith, nth);
}

Tensor pack_keys(Graph& g, const AttentionKernel& kernel, Tensor k, Tensor v) {
  const Tensor packed = custom(g, {kernel.packed_size(make_job(k.node(), v.node()))}, {k, v}, pack_task,
                               const_cast<AttentionKernel*>(&kernel));
  g.note_work(packed, {0, bytes(k) + bytes(v) + bytes(packed)});
  return packed;
}

enum Source { kQ, kK, kV, kPacked, kMask };

void run_task(ggml_tensor* out, int ith, int nth, void* user) {
  auto& node = *static_cast<AttentionNode*>(user);
  AttentionJob job = make_job(out->src[kQ], out->src[kK], out->src[kV]);
  job.packed = static_cast<float*>(out->src[kPacked]->data);
  job.mask = out->src[kMask] != nullptr ? values(out->src[kMask]) : nullptr;
  job.out = static_cast<float*>(out->data);
  job.turns = &node.turns;
  node.kernel->run(job, ith, nth);
}

}  // namespace

bool has_attention(const Graph& g, std::int64_t d_head) {
  return cpu_kernels(g.isa()) != nullptr && d_head <= kMaxHead;
}

Tensor attention(Graph& g, Tensor q, Tensor k, Tensor v, Tensor mask, Tensor packed) {
  return attention(g, cpu_kernels(g.isa())->attention, q, k, v, mask, packed);
}

Tensor attention(Graph& g, const AttentionKernel& kernel, Tensor q, Tensor k, Tensor v, Tensor mask, Tensor packed) {
  if (!packed) packed = pack_keys(g, kernel, k, v);
  const Tensor out = custom(g, {q.dim(0) * q.dim(1), q.dim(2), q.dim(3)}, {q, k, v, packed, mask}, run_task,
                            keep(g, AttentionNode{&kernel, {}}));
  g.note_work(out, {4.0 * static_cast<double>(ggml_nelements(q.node()) * k.dim(2)),
                    bytes(q) + bytes(packed) + (mask ? bytes(mask) : 0) + bytes(out)});
  return out;
}

Tensor pack_keys(Graph& g, Tensor k, Tensor v) { return pack_keys(g, cpu_kernels(g.isa())->attention, k, v); }

}  // namespace vla::kernels
