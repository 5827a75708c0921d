// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <map>

#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {
namespace {

class Layouts {
 public:
  explicit Layouts(CudaLowering& lowering) : l(lowering) {}

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
  }

 private:
  template <class What>
  static void put(CudaOp& to, What what) {
    to.op = std::move(what);
  }
  static void put(CudaOp&, PackOp) {}  // attention reads keys and values where they lie

  ValueId new_value(const Shape& shape) {
    const auto id = static_cast<ValueId>(l.values.size());
    Value& value = l.values.emplace_back();
    value.shape = shape, value.stride = contiguous_strides(shape), value.base = id;
    value.size = static_cast<std::size_t>(count(shape)) * 4;
    return id;
  }
  /// A contiguous copy, made just before the operation at hand.
  ValueId copied(ValueId id) {
    const Shape shape = l.value(id).shape;
    const ValueId copy = new_value(shape);
    CudaOp& op = l.ops.emplace_back();
    op.op = CopyOp{{{id, shape, l.value(id).stride, contiguous_strides(shape), 0}}};
    op.reads = {id}, op.writes = {copy}, op.order = step_->order;
    std::replace(step_->reads.begin(), step_->reads.end(), id, copy);
    return copy;
  }
  void require(ValueId& id, bool fits) {
    if (!fits) id = copied(id);
  }
  /// Elements of a row follow each other.
  void require_rows(ValueId& id) {
    if (id != kNone) require(id, l.value(id).shape[0] == 1 || l.value(id).stride[0] == 1);
  }
  void require_contiguous(ValueId& id) {
    if (id != kNone) require(id, is_contiguous(l.value(id)));
  }

  /// x normed and turned, as an operation just before the one at hand; x itself where nothing is done to it.
  void prepare(Prepared& rows) {
    require_rows(rows.x);
    if (rows.norm == nullptr && rows.rope == nullptr) return;
    require_contiguous(rows.weight);
    require_contiguous(rows.table);
    const ValueId to = new_value(l.value(rows.x).shape);
    CudaOp& op = l.ops.emplace_back();
    op.op = HeadOp{rows}, op.writes = {to}, op.order = step_->order;
    for (const ValueId id : {rows.x, rows.weight, rows.table})
      if (id != kNone) op.reads.push_back(id);
    std::replace(step_->reads.begin(), step_->reads.end(), rows.x, to);
    rows = {to};
  }
  /// What attention reads in the place of what PackOp would write.
  void note_keys(FusedOp& step, PackOp pack) {
    step_ = &step;
    prepare(pack.k);
    require_rows(pack.v);
    keys_[step.writes[0]] = {pack.k.x, pack.v};
  }

  void require_layouts(LinearOp& op) {
    require(op.x, row_stride(l.value(op.x)) >= 0);
    require_contiguous(op.residual);
    require_contiguous(op.factor);
    if (!op.gated) return;
    made_.gate = new_value(op.linears[0]->shape);
    step_->writes.push_back(made_.gate);
  }
  void require_layouts(PackOp&) {}
  void require_layouts(AttentionOp& op) {
    prepare(op.q);
    require_contiguous(op.mask);
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

  CudaLowering& l;
  Step* step_ = nullptr;  // the operation at hand
  CudaOp made_;           // what is added to it
  std::map<ValueId, std::pair<ValueId, ValueId>> keys_;
};

}  // namespace

void choose_layouts(CudaLowering& l, std::vector<FusedOp> ops) { Layouts(l).run(std::move(ops)); }

}  // namespace vla::lower
