// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/hopper_tma.h"
#include "cuda/kernels/linear_f32.h"
#include "cuda/kernels/linear_int8.h"
#include "kernels/quantized.h"
#include "lower/cuda/emit.h"

namespace vla::lower {
namespace {

cuda::Int8Shape int8_shape(cuda::Bf16Shape shape) {
  return shape == cuda::Bf16Shape::few      ? cuda::Int8Shape::few
         : shape == cuda::Bf16Shape::rows64 ? cuda::Int8Shape::rows64
                                            : cuda::Int8Shape::rows128;
}

cuda::RowMoments moments(const CudaLowering& l, const HalvedNorm& norm) {
  return {l.at(norm.squares), l.at(norm.sums), norm.n_part, norm.part};
}
cuda::NormBegin norm_begin(const CudaLowering& l, const HalvedNorm& norm) {
  if (norm.squares == kNone) return {};
  return {.rows = l.at<std::uint16_t>(norm.rows),
          .stride = l.value(norm.rows).stride[1],
          .weight = l.at(norm.weight),
          .bias = l.at(norm.bias),
          .moments = moments(l, norm)};
}

/// Adds a product whose operands TMA fetches. Errors: device.
Status add_tma_product(const CudaLowering& l, const cuda::HopperTmaTile& tile, const cuda::LinearBf16Job& product,
                       Calls& calls) {
  cuda::HopperTmaJob job = {.x = {}, .weight = {}, .gate_weight = {}, .product = product};
  if (l.gpu != nullptr) {
    VLA_CHECK(l.gpu->map_rows(mapped_x(tile, product), job.x));
    VLA_CHECK(l.gpu->map_rows(mapped_weight(tile, product, product.weight), job.weight));
    if (tile.is_gated) VLA_CHECK(l.gpu->map_rows(mapped_weight(tile, product, product.gate_weight), job.gate_weight));
  }
  calls.push_back(call(cuda::hopper_tma_bf16(tile, product), job));
  return {};
}

/// gate: the gate product, if the same kernel computes it with this one; else null. Errors: device.
Status add_product(const CudaLowering& l, const CudaOp& op, ValueId of, const CudaWeight& matrix, const Param& weight,
                   const cuda::Epilogue& end, const op::Linear* gate, Calls& calls) {
  const Value& x = l.value(of);
  const int rows = narrow(rows_of(x.shape)), columns = narrow(weight.shape[1]), depth = narrow(x.shape[0]);
  const auto [shape, n_split, tile, in_cluster, us, by_tma] = op.cut;
  switch (matrix.kind) {
    case MatrixKind::f32: {
      const cuda::LinearF32Job job = {.x = l.at(of),
                                      .weight = l.param(&weight),
                                      .x_stride = row_stride(x),
                                      .n_row = rows,
                                      .n_column = columns,
                                      .depth = depth,
                                      .end = end};
      calls.push_back(call(cuda::linear_f32(job), job));
      return {};
    }
    case MatrixKind::bf16: {
      const cuda::LinearBf16Job job = {
          .x = l.at<void>(of),
          .weight = l.param<std::uint16_t>(&weight),
          .x_stride = row_stride(x),
          .weight_stride = bf16_stride(depth),
          .n_row = rows,
          .n_column = columns,
          .depth = depth,
          .n_split = n_split,
          .partial = l.at(op.partial),
          .end = end,
          .gate_weight = gate ? l.param<std::uint16_t>(gate->weight) : nullptr,
          .gate_bias = gate ? l.param(gate->bias) : nullptr,
          .rotation = {l.at(op.rotation.table), narrow(op.rotation.d_head), narrow(op.rotation.n_token)},
          .norm_begin = norm_begin(l, op.begins),
          .norm_end = {moments(l, op.ends), op.ends.eps, op.ends.bias != kNone}};
      if (by_tma) return add_tma_product(l, *cuda::tma_tile_of(cuda::kHopperTiles[*tile]), job, calls);
      calls.push_back(
          call(tile ? cuda::hopper_linear_bf16(cuda::kHopperTiles[*tile], job) : cuda::linear_bf16(shape, job), job));
      if (op.partial != kNone && !leaves_shares(op)) calls.push_back(call(cuda::finish_bf16_partial(job), job));
      return {};
    }
    case MatrixKind::ternary:
    case MatrixKind::int4:
    case MatrixKind::int8: {
      const cuda::LinearInt8Job job = {.x = l.at<std::byte>(of),
                                       .weight = l.param<std::byte>(&weight),
                                       .scale = reinterpret_cast<const float*>(matrix.scales),
                                       .x_stride = x.stride[1],
                                       .n_row = rows,
                                       .n_column = columns,
                                       .depth = narrow(kernels::quantized_depth(depth)),
                                       .n_split = n_split,
                                       .partial = l.at<int>(op.partial),
                                       .end = end};
      calls.push_back(call(tile ? cuda::hopper_linear_int8(cuda::kHopperInt8Tiles[*tile], job)
                                : cuda::linear_int8(code_kind(matrix.kind), int8_shape(shape), job),
                           job));
      if (op.partial != kNone) calls.push_back(call(cuda::finish_int8_partial(job), job));
      return {};
    }
  }
  return {};
}

}  // namespace

Result<Calls> calls_of(const CudaLowering& l, const CudaOp& op, const LinearOp& linear) {
  Calls calls;
  for (std::size_t i = 0; i < linear.linears.size(); ++i) {
    const Node& node = *linear.linears[i];
    const auto& product = *node.as<op::Linear>();
    const CudaWeight& matrix = l.matrix(node);
    if (product.rule != op::Rule::floats && matrix.kind != MatrixKind::ternary)
      return Error{Code::unsupported, product.weight->name, "a ternary matrix", dtype_name(matrix.encoding.type),
                   "use --kernels ggml"};
    const bool is_gate = linear.gated && i == 0, is_one = linear.gated && op.gate == kNone;
    if (is_gate && is_one) continue;
    const ValueId to = is_gate ? op.gate : op.writes[0];
    cuda::Epilogue end = {};
    end.bias = l.param(product.bias), end.y = l.at(to);
    end.is_bf16 = l.value(to).type == DType::bf16;
    end.y_stride = end.is_bf16 ? l.value(to).stride[1] : product.weight->shape[1];
    if (!is_gate) {
      end.activation = linear.activation, end.gate = l.at(op.gate), end.ends_in_relu = linear.ends_in_relu;
      end.factor = l.at(linear.factor), end.residual = l.at(linear.residual);
    }
    const op::Linear* gate = is_one ? linear.linears[0]->as<op::Linear>() : nullptr;
    VLA_CHECK(add_product(l, op, linear.x, matrix, *product.weight, end, gate, calls));
  }
  return calls;
}

}  // namespace vla::lower
