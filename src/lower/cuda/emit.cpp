// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <cmath>

#include "cuda/kernels/attention.h"
#include "cuda/kernels/channel_attention.h"
#include "cuda/kernels/linear_bf16.h"
#include "cuda/kernels/linear_f32.h"
#include "cuda/kernels/linear_int8.h"
#include "cuda/kernels/map.h"
#include "cuda/kernels/rows.h"
#include "cuda/kernels/window.h"
#include "kernels/quantized.h"
#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {
namespace {

using Emitted = Result<Calls>;

/// more: "heads of at most".
Error unsupported(const char* what, const char* more, std::int64_t most, std::int64_t found) {
  return {Code::unsupported, what, more + (" " + std::to_string(most)), std::to_string(found), "use --kernels ggml"};
}

template <class Job>
Call call(const cuda::Launch& how, const Job& job) {
  const auto* bytes = reinterpret_cast<const std::byte*>(&job);
  return {how, {bytes, bytes + sizeof(job)}};
}
int narrow(std::int64_t n) { return static_cast<int>(n); }
std::int64_t n_row(const Shape& shape) { return count(shape) / shape[0]; }

/// Element by element over a shape; b may be missing.
cuda::MapJob map_of(const Shape& shape, const float* a, const Shape& a_step, float* y, const Shape& y_step) {
  cuda::MapJob job = {};
  job.a = a, job.y = y, job.factor = 1;
  for (std::size_t i = 0; i < static_cast<std::size_t>(cuda::MapJob::kDims); ++i) {
    job.size[i] = i < 4 ? narrow(shape[i]) : 1;
    if (i < 4) job.a_step[i] = a_step[i], job.y_step[i] = y_step[i];
  }
  return job;
}

struct Emit {
  const CudaLowering& l;
  const CudaOp& op;

  float* result() const { return l.at(op.writes[0]); }

  Emitted operator()(const LinearOp& linear) const {
    Calls calls;
    for (std::size_t i = 0; i < linear.linears.size(); ++i) {
      const Node& node = *linear.linears[i];
      const auto& product = *node.as<op::Linear>();
      const CudaWeight& matrix = l.matrix(node);
      if (product.rule != op::Rule::floats && matrix.kind != MatrixKind::ternary)
        return Error{Code::unsupported, product.weight->name, "a ternary matrix", dtype_name(matrix.encoding.type),
                     "use --kernels ggml"};
      const bool is_gate = linear.gated && i == 0;
      const ValueId to = is_gate ? op.gate : op.writes[0];
      cuda::Epilogue end = {};
      end.bias = l.param(product.bias), end.y = l.at(to);
      end.is_bf16 = l.value(to).type == DType::bf16;
      end.y_stride = end.is_bf16 ? l.value(to).stride[1] : product.weight->shape[1];
      if (!is_gate) {
        end.activation = linear.activation, end.gate = l.at(op.gate), end.ends_in_relu = linear.ends_in_relu;
        end.factor = l.at(linear.factor), end.residual = l.at(linear.residual);
      }
      add_product(calls, linear, matrix, *product.weight, end);
    }
    return calls;
  }
  void add_product(Calls& calls, const LinearOp& linear, const CudaWeight& matrix, const Param& weight,
                   const cuda::Epilogue& end) const {
    const Value& x = l.value(linear.x);
    const int rows = narrow(n_row(x.shape)), columns = narrow(weight.shape[1]), depth = narrow(x.shape[0]);
    const ProductShape shape = product_shape(matrix.kind, rows, columns, l.n_sm);
    switch (matrix.kind) {
      case MatrixKind::f32: {
        const cuda::LinearF32Job job = {l.at(linear.x), l.param(&weight), row_stride(x), rows, columns, depth, end};
        calls.push_back(call(cuda::linear_f32(job), job));
        return;
      }
      case MatrixKind::bf16: {
        const cuda::LinearBf16Job job = {l.at<void>(linear.x),
                                         l.param<std::uint16_t>(&weight),
                                         row_stride(x),
                                         bf16_stride(depth),
                                         rows,
                                         columns,
                                         depth,
                                         op.n_split,
                                         l.at(op.partial),
                                         end};
        const cuda::Bf16Shape tile = shape == ProductShape::few      ? cuda::Bf16Shape::few
                                     : shape == ProductShape::rows64 ? cuda::Bf16Shape::rows64
                                                                     : cuda::Bf16Shape::rows128;
        calls.push_back(call(cuda::linear_bf16(tile, job), job));
        if (job.n_split > 1) calls.push_back(call(cuda::finish_bf16_partial(job), job));
        return;
      }
      case MatrixKind::ternary:
      case MatrixKind::int8: {
        const cuda::LinearInt8Job job = {l.at<std::byte>(linear.x),
                                         l.param<std::byte>(&weight),
                                         reinterpret_cast<const float*>(matrix.scales),
                                         x.stride[1],
                                         rows,
                                         columns,
                                         narrow(kernels::quantized_depth(depth)),
                                         op.n_split,
                                         l.at<int>(op.partial),
                                         end};
        const cuda::Int8Shape tile = shape == ProductShape::few      ? cuda::Int8Shape::few
                                     : shape == ProductShape::rows64 ? cuda::Int8Shape::rows64
                                                                     : cuda::Int8Shape::rows128;
        const auto kind = matrix.kind == MatrixKind::ternary ? cuda::CodeKind::ternary : cuda::CodeKind::int8;
        calls.push_back(call(cuda::linear_int8(kind, tile, job), job));
        if (job.n_split > 1) calls.push_back(call(cuda::finish_int8_partial(job), job));
        return;
      }
    }
  }

  /// Heads of a value, normed or turned, to a contiguous one.
  Emitted heads(ValueId id, const float* weight, float eps, const float* table) const {
    const Value& x = l.value(id);
    if (x.shape[0] > cuda::kMaxHead) return unsupported("heads", "heads of at most", cuda::kMaxHead, x.shape[0]);
    const Shape to = contiguous_strides(x.shape);
    const cuda::HeadJob job = {l.at(id),
                               result(),
                               weight,
                               table,
                               x.stride[1],
                               x.stride[2],
                               x.stride[3],
                               to[1],
                               to[2],
                               to[3],
                               narrow(x.shape[0]),
                               narrow(x.shape[1]),
                               narrow(x.shape[2]),
                               narrow(x.shape[3]),
                               eps,
                               l.value(op.writes[0]).type == DType::bf16};
    return Calls{call(cuda::head_rows(job), job)};
  }
  Emitted operator()(const HeadOp& head) const {
    const auto* norm = head.rows.norm != nullptr ? head.rows.norm->as<op::Norm>() : nullptr;
    if (norm != nullptr && norm->kind != op::NormKind::rms)
      return Error{Code::unsupported, "heads", "an RMS norm", "a layer norm", "use --kernels ggml"};
    return heads(head.rows.x, l.at(head.rows.weight), norm != nullptr ? norm->eps : 0, l.at(head.rows.table));
  }

  Emitted operator()(const AttentionOp& attention) const {
    const Value& q = l.value(attention.q.x);
    if (q.shape[0] > cuda::kMaxHead) return unsupported("attention", "heads of at most", cuda::kMaxHead, q.shape[0]);
    if (op.keys.size() > static_cast<std::size_t>(cuda::AttentionJob::kMaxSegment))
      return unsupported("attention", "segments of keys: at most", cuda::AttentionJob::kMaxSegment,
                         static_cast<std::int64_t>(op.keys.size()));
    cuda::AttentionJob job = {};
    const auto rows = [&](ValueId id) {
      const Shape& stride = l.value(id).stride;
      return cuda::HeadRows{l.at<void>(id), stride[1], stride[2], stride[3]};
    };
    job.q = rows(attention.q.x);
    for (std::size_t i = 0; i < op.keys.size(); ++i)
      job.segment[job.n_segment++] = {rows(op.keys[i].first), rows(op.keys[i].second), narrow(attention.n_key[i])};
    job.mask = l.at(attention.mask), job.y = result();
    job.scale = 1 / std::sqrt(static_cast<float>(q.shape[0]));
    job.d_head = narrow(q.shape[0]), job.n_head = narrow(q.shape[1]), job.n_query = narrow(q.shape[2]);
    job.n_batch = narrow(q.shape[3]), job.n_head_kv = narrow(l.value(op.keys[0].first).shape[1]);
    job.n_split = op.n_split, job.partial = l.at(op.partial), job.is_bf16 = l.value(op.writes[0]).type == DType::bf16;
    Calls calls = {call(attention.rounds ? cuda::attention_bf16(job) : cuda::attention_f32(job), job)};
    if (job.n_split > 1) calls.push_back(call(cuda::finish_attention(job), job));
    return calls;
  }

  Emitted operator()(const RoundOp& round) const {
    const Value& y = l.value(op.writes[0]);
    cuda::NormJob job = norm_of(round.x, round.norm != nullptr ? round.norm->as<op::Norm>() : nullptr);
    job.weight = l.at(round.weight), job.bias = l.at(round.bias), job.y_stride = y.stride[1];
    job.type = y.type == DType::i8     ? cuda::RowType::codes
               : y.type == DType::bf16 ? cuda::RowType::bf16
                                       : cuda::RowType::f32;
    return Calls{call(cuda::norm_rows(job), job)};
  }
  /// Rows of x, normed unless there is no norm, to the result.
  cuda::NormJob norm_of(ValueId id, const op::Norm* norm) const {
    const Value& x = l.value(id);
    cuda::NormJob job = {};
    job.x = l.at(id), job.y = result(), job.x_stride = row_stride(x), job.y_stride = x.shape[0];
    job.n_row = narrow(n_row(x.shape)), job.n = narrow(x.shape[0]);
    if (norm == nullptr) return job;
    job.eps = norm->eps, job.norm = norm->kind == op::NormKind::rms ? cuda::RowNorm::rms : cuda::RowNorm::layer;
    return job;
  }

  Emitted operator()(const RowOp& row) const {
    return std::visit([&](const auto& what) { return rows(row, what); }, row.what);
  }
  Emitted rows(const RowOp& row, const op::Norm& norm) const {
    cuda::NormJob job = norm_of(row.x, &norm);
    job.weight = l.at(row.w), job.bias = l.at(row.b);
    return Calls{call(cuda::norm_rows(job), job)};
  }
  Emitted rows(const RowOp& row, const op::Rope&) const { return heads(row.x, nullptr, 0, l.at(row.w)); }
  Emitted rows(const RowOp& row, const op::Activate& activate) const {
    cuda::MapJob job = map_of(row);
    job.activation = activate.activation;
    return Calls{call(cuda::map_elements(job), job)};
  }
  Emitted rows(const RowOp& row, const op::Scale& scale) const {
    cuda::MapJob job = map_of(row);
    job.factor = scale.factor;
    return Calls{call(cuda::map_elements(job), job)};
  }
  Emitted rows(const RowOp& row, const op::Add&) const { return with_other(row, cuda::MapOperation::add); }
  Emitted rows(const RowOp& row, const op::Multiply&) const { return with_other(row, cuda::MapOperation::multiply); }
  Emitted with_other(const RowOp& row, cuda::MapOperation operation) const {
    cuda::MapJob job = map_of(row);
    const Value& w = l.value(row.w);
    job.operation = operation, job.b = l.at(row.w);
    for (std::size_t i = 0; i < 4; ++i) job.b_step[i] = w.shape[i] == 1 ? 0 : w.stride[i];
    return Calls{call(cuda::map_elements(job), job)};
  }
  cuda::MapJob map_of(const RowOp& row) const {
    const Shape& shape = row.node->shape;
    return lower::map_of(shape, l.at(row.x), l.value(row.x).stride, result(), contiguous_strides(shape));
  }

  Emitted operator()(const CopyOp& copy) const {
    Calls calls;
    for (const CopyOp::Part& part : copy.parts) {
      const cuda::MapJob job = lower::map_of(part.shape, l.at(part.from) + part.from_offset, part.from_stride,
                                             result() + part.to_offset, part.to_stride);
      if (job.count() > 0) calls.push_back(call(cuda::map_elements(job), job));
    }
    return calls;
  }

  Emitted operator()(const LookupOp& lookup) const {
    const Node& node = *lookup.node;
    cuda::LookupJob job = {};
    job.ids = l.at<std::int32_t>(lookup.ids), job.y = result();
    job.n = narrow(node.shape[0]), job.n_row = narrow(node.shape[1]);
    if (const auto* embedding = node.as<op::Embedding>()) {
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

  Emitted operator()(const PatchesOp& patches) const {
    const Node& node = *patches.node;
    const int size = node.as<op::Patches>()->size, width = narrow(node.in[0].dim(0)),
              height = narrow(node.in[0].dim(1));
    const std::int64_t columns = width / size, lines = height / size, area = std::int64_t{size} * size;
    const std::int64_t w = width, patch = 3 * area;
    const cuda::MapJob job = {l.at(patches.images),
                              nullptr,
                              result(),
                              {size, size, 3, narrow(columns), narrow(lines), narrow(node.in[0].dim(3))},
                              {1, w, w * height, size, size * w, w * height * 3},
                              {},
                              {1, size, area, patch, patch * columns, patch * columns * lines},
                              1,
                              cuda::MapOperation::copy,
                              Activation::none,
                              false};
    return Calls{call(cuda::map_elements(job), job)};
  }

  Emitted operator()(const WindowOp& window) const {
    const Shape &x = l.value(window.x).shape, &places = window.node->shape;
    const Value& y = l.value(op.writes[0]);
    const cuda::WindowJob job = {l.at(window.x),    l.at(window.weight), l.at(window.bias),    result(),
                                 y.stride[1],       narrow(x[0]),        narrow(x[1]),         narrow(x[2]),
                                 narrow(x[3]),      window.window.size,  window.window.stride, window.window.padding,
                                 narrow(places[1]), narrow(places[2]),   window.takes_largest, y.type == DType::bf16};
    return Calls{call(cuda::window_elements(job), job)};
  }

  Emitted operator()(const ChannelOp& channels) const {
    const Shape& x = channels.node->shape;
    static_assert(op::ChannelAttention::kMaxGroup <= cuda::kMaxChannels);
    const cuda::ChannelAttentionJob job = {l.at(channels.q),
                                           l.at(channels.k),
                                           l.at(channels.v),
                                           result(),
                                           row_stride(l.value(channels.q)),
                                           row_stride(l.value(channels.k)),
                                           row_stride(l.value(channels.v)),
                                           narrow(x[0]),
                                           narrow(x[1]),
                                           narrow(x[2]),
                                           channels.node->as<op::ChannelAttention>()->n_group};
    return Calls{call(cuda::channel_attention(job), job)};
  }
};

}  // namespace

Result<Calls> emit(const CudaLowering& l, const CudaOp& op) {
  return std::visit([&](const auto& what) -> Result<Calls> { return Emit{l, op}(what); }, op.op);
}

}  // namespace vla::lower
