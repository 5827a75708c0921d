// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <map>
#include <numeric>
#include <tuple>

#include "cuda/kernels/linear_bf16.h"
#include "cuda/kernels/linear_int8.h"
#include "cuda/kernels/rows.h"
#include "kernels/quantized.h"
#include "lower/copies.h"
#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {
namespace {

class Layouts : Copies<CudaLowering> {
 public:
  explicit Layouts(CudaLowering& lowering) : Copies(lowering) {}

  void run(std::vector<FusedOp> ops) {
    for (FusedOp& op : ops) {
      if (const auto* pack = std::get_if<PackOp>(&op.op)) {
        note_keys(op, *pack);
        continue;
      }
      step_ = &op, made_ = {};
      std::visit([&](auto& what) { require_layouts(what); }, op.op);
      CudaOp& added = l.ops.emplace_back(std::move(made_));
      static_cast<Step&>(added) = std::move(static_cast<Step&>(op));
      std::visit([&](auto& what) { put(added, std::move(what)); }, op.op);
    }
    for (const CudaOp& op : l.ops)
      for (const ValueId id : op.reads) ++n_reader_[l.value(id).base];
    for (CudaOp& op : l.ops)
      if (auto* round = std::get_if<RoundOp>(&op.op)) round_at_once(op, *round);
    std::erase_if(l.ops, [](const CudaOp& op) { return op.writes.empty(); });
  }

 private:
  template <class What>
  static void put(CudaOp& to, What what) {
    to.op = std::move(what);
  }
  static void put(CudaOp&, PackOp) {}  // attention reads keys and values where they lie

  /// `row`: elements from one row to the next.
  ValueId new_value(const Shape& shape, DType type = DType::f32, std::int64_t row = 0) {
    const auto id = static_cast<ValueId>(l.values.size());
    Value& value = l.values.emplace_back();
    const Shape padded = {row > 0 ? row : shape[0], shape[1], shape[2], shape[3]};
    value.type = type, value.shape = shape, value.stride = contiguous_strides(padded), value.base = id;
    value.size = dtype_size(type, count(padded));
    return id;
  }
  /// Floats for shares of a product or of attention.
  void take_partial(std::int64_t n) {
    if (made_.n_split == 1) return;
    made_.partial = new_value({n, made_.n_split, 1, 1});
    step_->writes.push_back(made_.partial);
  }
  /// x normed and turned, as an operation just before the one at hand; x itself where nothing is done to it.
  void prepare(Prepared& rows, bool rounds) {
    require_rows(rows.x);
    if (rows.norm == nullptr && rows.rope == nullptr && !rounds) return;
    require_contiguous(rows.weight);
    require_contiguous(rows.table);
    const ValueId to = new_value(l.value(rows.x).shape, rounds ? DType::bf16 : DType::f32);
    CudaOp& op = l.ops.emplace_back();
    op.op = HeadOp{rows}, op.writes = {to}, op.order = step_->order;
    for (const ValueId id : {rows.x, rows.weight, rows.table})
      if (id != kNone) op.reads.push_back(id);
    std::replace(step_->reads.begin(), step_->reads.end(), rows.x, to);
    rows = {to};
  }
  /// Notes the rows that attention reads in the place of what PackOp would write.
  void note_keys(FusedOp& step, PackOp pack) {
    step_ = &step;
    const bool rounds = rounds_heads(pack.rounds, pack.k);
    Prepared v = {pack.v};
    prepare(pack.k, rounds);
    prepare(v, rounds);
    keys_[step.writes[0]] = {pack.k.x, v.x};
  }
  /// Kernels of bf16 read heads of whole 16 bytes.
  bool rounds_heads(bool rounds, const Prepared& rows) const { return rounds && l.value(rows.x).shape[0] % 8 == 0; }

  void require_layouts(LinearOp& op) {
    require_contiguous(op.residual);
    require_contiguous(op.factor);
    const MatrixKind kind = l.matrix(*op.linears[0]).kind;
    const Shape y = op.linears[0]->shape;
    const std::int64_t depth = l.value(op.x).shape[0], n_row = count(y) / y[0];
    const bool is_few = product_shape(kind, n_row, y[0], l.n_sm) == ProductShape::few;
    if (kind == MatrixKind::ternary || kind == MatrixKind::int8)
      convert(op, DType::i8);
    else if (kind == MatrixKind::bf16 && !is_few)
      convert(op, DType::bf16);
    else if (op.norm != nullptr)
      convert(op, DType::f32);
    else
      require(op.x, row_stride(l.value(op.x)) >= 0);
    if (op.gated) {
      made_.gate = new_value(y);
      step_->writes.push_back(made_.gate);
    }
    made_.n_split = splits(kind, n_row, y[0], depth);
    take_partial(y[0] * n_row);
  }
  /// The number of shares of the depth, each of 8 steps or more: 1 unless blocks are fewer than run at a time.
  int splits(MatrixKind kind, std::int64_t n_row, std::int64_t n_column, std::int64_t depth) const {
    if (kind == MatrixKind::f32) return 1;
    const ProductShape shape = product_shape(kind, n_row, n_column, l.n_sm);
    const std::int64_t step = kind == MatrixKind::bf16 ? cuda::kBf16Depth : cuda::Int8Tile::kDepth;
    std::int64_t n_block = (n_column + 63) / 64 * ((n_row + 63) / 64);
    if (shape == ProductShape::rows128) n_block = (n_column + 127) / 128 * ((n_row + 127) / 128);
    if (shape == ProductShape::few) n_block = kind == MatrixKind::bf16 ? (n_column + 7) / 8 : (n_column + 127) / 128;
    const std::int64_t most = (depth + step - 1) / step / 8;
    return static_cast<int>(
        std::clamp<std::int64_t>(l.n_sm / std::max<std::int64_t>(n_block, 1), 1, std::max<std::int64_t>(most, 1)));
  }

  /// The product reads x, or its norm, as this.
  void convert(LinearOp& op, DType type) {
    const auto [known, is_new] = rounded_.try_emplace({op.x, op.norm, type}, kNone);
    if (is_new) {
      const Shape shape = l.value(op.x).shape;
      RoundOp made = {op.x, op.norm, op.norm_weight, op.norm_bias};
      require(made.x, row_stride(l.value(made.x)) >= 0);
      require_contiguous(made.weight);
      require_contiguous(made.bias);
      known->second = new_value(shape, type, converted_stride(type, shape[0]));
      CudaOp& rounded = l.ops.emplace_back();
      for (const ValueId id : {made.x, made.weight, made.bias})
        if (id != kNone) rounded.reads.push_back(id);
      rounded.op = made, rounded.writes = {known->second}, rounded.order = step_->order;
    }
    op.x = known->second, op.norm = nullptr, op.norm_weight = op.norm_bias = kNone;
    step_->reads = {op.x};
    for (const ValueId id : {op.factor, op.residual})
      if (id != kNone) step_->reads.push_back(id);
  }
  static std::int64_t converted_stride(DType type, std::int64_t n) {
    return type == DType::i8 ? kernels::quantized_stride(n) : type == DType::bf16 ? bf16_stride(n) : n;
  }
  /// Rounds the result of a product, attention or a window as it is stored, where nobody else reads it.
  void round_at_once(CudaOp& round, const RoundOp& what) {
    const Value &x = l.value(what.x), &to = l.value(round.writes[0]);
    const bool is_whole =
        x.base == what.x && x.placement == Value::Placement::arena && x.node != nullptr && !x.node->tapped;
    if (what.norm != nullptr || to.type != DType::bf16 || !is_whole || n_reader_[what.x] != 1) return;
    const auto maker = std::find_if(l.ops.begin(), l.ops.end(),
                                    [&](const CudaOp& op) { return !op.writes.empty() && op.writes[0] == what.x; });
    if (maker == l.ops.end()) return;
    const bool is_attention = std::holds_alternative<AttentionOp>(maker->op) && x.shape[0] % 8 == 0;
    const bool is_other = std::holds_alternative<LinearOp>(maker->op) || std::holds_alternative<WindowOp>(maker->op);
    if (!is_attention && !is_other) return;
    maker->writes[0] = round.writes[0];
    round.writes.clear();
  }
  void require_layouts(PackOp&) {}
  void require_layouts(AttentionOp& op) {
    op.rounds = rounds_heads(op.rounds, op.q);
    prepare(op.q, op.rounds);
    require_contiguous(op.mask);
    const Shape q = l.value(op.q.x).shape;
    const std::int64_t n_key = std::accumulate(op.n_key.begin(), op.n_key.end(), std::int64_t{0});
    const std::int64_t n_head = q[1] * q[3], rows = op.rounds ? 64 : 8;
    const std::int64_t n_block = n_head * ((q[2] + rows - 1) / rows);  // at least so many
    made_.n_split = static_cast<int>(std::clamp<std::int64_t>(l.n_sm / n_block, 1, (n_key + 127) / 128));
    take_partial((q[0] + 2) * q[2] * n_head);
    for (const ValueId packed : op.packed) {
      const auto& [k, v] = made_.keys.emplace_back(keys_.at(packed));
      std::erase(step_->reads, packed);
      step_->reads.push_back(k), step_->reads.push_back(v);
    }
  }
  void require_layouts(RowOp& op) {
    if (std::holds_alternative<op::Norm>(op.what)) require(op.x, row_stride(l.value(op.x)) >= 0);
    if (std::holds_alternative<op::Rope>(op.what)) require_rows(op.x);
    if (std::holds_alternative<op::Norm>(op.what) || std::holds_alternative<op::Rope>(op.what)) {
      require_contiguous(op.w);
      require_contiguous(op.b);
    }
  }
  void require_layouts(CopyOp&) {}  // takes anything
  void require_layouts(LookupOp& op) {
    require_contiguous(op.table);
    require_contiguous(op.ids);
  }
  void require_layouts(PatchesOp& op) { require_contiguous(op.images); }
  void require_layouts(WindowOp& op) {
    require_contiguous(op.x);
    require_contiguous(op.weight);
    require_contiguous(op.bias);
  }
  void require_layouts(ChannelOp& op) {
    for (ValueId* id : {&op.q, &op.k, &op.v}) require(*id, row_stride(l.value(*id)) >= 0);
  }

  CudaOp made_;  // what is added to the operation at hand
  std::map<ValueId, std::pair<ValueId, ValueId>> keys_;
  std::map<std::tuple<ValueId, const Node*, DType>, ValueId> rounded_;
  std::map<ValueId, int> n_reader_;  // of each base and its views
};

}  // namespace

ProductShape product_shape(MatrixKind kind, std::int64_t n_row, std::int64_t n_column, int n_sm) {
  if (n_row <= (kind == MatrixKind::bf16 ? cuda::kBf16FewRows : 4)) return ProductShape::few;
  const std::int64_t n_block = (n_row + 127) / 128 * ((n_column + 127) / 128);
  return n_row > 64 && n_block >= n_sm ? ProductShape::rows128 : ProductShape::rows64;
}

void choose_layouts(CudaLowering& l, std::vector<FusedOp> ops) { Layouts(l).run(std::move(ops)); }

}  // namespace vla::lower
