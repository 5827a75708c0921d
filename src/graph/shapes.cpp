// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "graph/shapes.h"

#include <algorithm>

namespace vla {
namespace {

/// One rule for each operation, in the order of graph/op.h.
struct Rules {
  const std::vector<Tensor>& in;
  const Shape& asked;

  bool has(std::size_t n) const {
    return in.size() == n && std::all_of(in.begin(), in.end(), [](Tensor x) { return static_cast<bool>(x); });
  }
  const Shape& of(std::size_t i) const { return in[i].shape(); }
  bool is_ids(std::size_t i) const { return in[i].node()->type == DType::i32 && of(i)[0] == count(of(i)); }
  bool floats() const {
    return std::all_of(in.begin(), in.end(), [](Tensor x) { return x && x.node()->type == DType::f32; });
  }
  /// b is broadcast where it has 1 in a dimension.
  static bool broadcasts(const Shape& a, const Shape& b) {
    for (std::size_t i = 0; i < 4; ++i)
      if (b[i] != a[i] && b[i] != 1) return false;
    return true;
  }
  ShapeCheck same_as_first(bool fits) const { return fits ? ShapeCheck{true, of(0)} : ShapeCheck{false}; }

  ShapeCheck operator()(const op::Input& op) const { return {in.empty(), op.slot->shape, op.slot->type}; }
  ShapeCheck operator()(const op::Constant& op) const {
    const bool ids = op.values.index() == 1;
    const std::size_t n = ids ? std::get<1>(op.values).size() : std::get<0>(op.values).size();
    return {static_cast<std::int64_t>(n) == count(asked), asked, ids ? DType::i32 : DType::f32};
  }
  ShapeCheck operator()(const op::Parameter& op) const {
    return {op.param->storage == Storage::vector && op.param->count() == count(asked), asked};
  }
  ShapeCheck operator()(const op::Linear& op) const {
    if (!has(1) || !floats() || of(0)[0] != op.weight->shape[0]) return {false};
    if ((op.weight->encoding.type == DType::ternary) != (op.rule == op::Rule::int8_rows)) return {false};
    return {op.bias == nullptr || op.bias->shape[0] == op.weight->shape[1],
            {op.weight->shape[1], of(0)[1], of(0)[2], of(0)[3]}};
  }
  ShapeCheck operator()(const op::Embedding& op) const {
    if (!has(1) || !is_ids(0)) return {false};
    return {op.table->storage == Storage::table, {op.table->shape[0], of(0)[0], 1, 1}};
  }
  ShapeCheck operator()(const op::Gather&) const {
    if (!has(2) || !is_ids(1)) return {false};
    return {of(0)[2] == 1 && of(0)[3] == 1, {of(0)[0], of(1)[0], 1, 1}, in[0].node()->type};
  }
  ShapeCheck operator()(const op::Norm&) const {
    if (in.empty() || in.size() > 3 || !has(in.size()) || !floats()) return {false};
    bool fits = true;
    for (std::size_t i = 1; i < in.size(); ++i) fits = fits && of(i)[0] == of(0)[0] && count(of(i)) == of(0)[0];
    return same_as_first(fits);
  }
  ShapeCheck operator()(const op::Rope&) const {
    return same_as_first(has(2) && floats() && of(0)[0] % 2 == 0 && of(1)[0] == of(0)[0] &&
                         count(of(1)) == of(0)[0] * of(0)[2]);
  }
  ShapeCheck operator()(const op::Attention& op) const {
    const std::size_t first = op.has_mask ? 2 : 1;
    if (in.size() < first + 2 || (in.size() - first) % 2 != 0 || !has(in.size()) || !floats()) return {false};
    const Shape &q = of(0), &k = of(first);
    std::int64_t n_key = 0;
    bool fits = q[1] % k[1] == 0;
    for (std::size_t i = first; i < in.size(); ++i) {
      fits = fits && of(i)[0] == q[0] && of(i)[1] == k[1] && of(i)[3] == q[3];
      if ((i - first) % 2 == 0)
        n_key += of(i)[2];
      else
        fits = fits && of(i)[2] == of(i - 1)[2];
    }
    if (op.has_mask) fits = fits && of(1)[0] == n_key && of(1)[1] == q[2] && count(of(1)) == n_key * q[2];
    return {fits, {q[0] * q[1], q[2], q[3], 1}};
  }
  ShapeCheck operator()(const op::Activate&) const { return same_as_first(has(1) && floats()); }
  ShapeCheck operator()(const op::Add&) const { return same_as_first(has(2) && floats() && broadcasts(of(0), of(1))); }
  ShapeCheck operator()(const op::Multiply&) const {
    return same_as_first(has(2) && floats() && broadcasts(of(0), of(1)));
  }
  ShapeCheck operator()(const op::Scale&) const { return same_as_first(has(1) && floats()); }
  ShapeCheck operator()(const op::Concat& op) const {
    if (in.empty() || !has(in.size()) || !floats()) return {false};
    const auto dim = static_cast<std::size_t>(op.dim);
    Shape shape = of(0);
    bool fits = dim < 4;
    for (std::size_t i = 1; fits && i < in.size(); ++i) {
      for (std::size_t j = 0; j < 4; ++j) fits = fits && (j == dim || of(i)[j] == shape[j]);
      shape[dim] += of(i)[dim];
    }
    return {fits, shape};
  }
  ShapeCheck operator()(const op::Slice& op) const {
    if (!has(1)) return {false};
    const auto dim = static_cast<std::size_t>(op.dim);
    bool fits = dim < 4 && op.first >= 0 && asked[dim] >= 1 && op.first + asked[dim] <= of(0)[dim];
    for (std::size_t j = 0; fits && j < 4; ++j) fits = j == dim || asked[j] == of(0)[j];
    return {fits, asked, in[0].node()->type};
  }
  ShapeCheck operator()(const op::Repeat&) const { return {has(1) && floats() && broadcasts(asked, of(0)), asked}; }
  ShapeCheck operator()(const op::Reshape&) const {
    if (!has(1)) return {false};
    return {count(asked) == count(of(0)), asked, in[0].node()->type};
  }
  ShapeCheck operator()(const op::Permute& op) const {
    std::array<int, 4> sorted = op.order;
    std::sort(sorted.begin(), sorted.end());
    if (!has(1) || !floats() || sorted != std::array{0, 1, 2, 3}) return {false};
    Shape shape;
    for (std::size_t i = 0; i < 4; ++i) shape[i] = of(0)[static_cast<std::size_t>(op.order[i])];
    return {true, shape};
  }
  ShapeCheck operator()(const op::Patches& op) const {
    if (!has(1) || !floats() || of(0)[2] != 3) return {false};
    const std::int64_t p = op.size, n = (of(0)[0] / p) * (of(0)[1] / p);
    return {n > 0, {3 * p * p, n, of(0)[3], 1}};
  }
  ShapeCheck operator()(const op::PixelShuffle& op) const {
    if (!has(1) || !floats()) return {false};
    const std::int64_t f = op.factor, n = of(0)[1];
    const bool fits = f > 0 && op.n_column % f == 0 && n % op.n_column == 0 && n / op.n_column % f == 0;
    return {fits && of(0)[3] == 1, {of(0)[0] * f * f, n / (f * f), of(0)[2], 1}};
  }
  ShapeCheck operator()(const op::Unfold& op) const {
    const std::int64_t area = std::int64_t{op.window.size} * op.window.size;
    return places(op.window, has(1) && op.window.padding >= 0, area);
  }
  ShapeCheck operator()(const op::MaxPool& op) const {
    return places(op.window, has(1) && op.window.padding >= 0 && 2 * op.window.padding <= op.window.size, 1);
  }
  ShapeCheck operator()(const op::Depthwise& op) const {
    if (!has(3)) return {false};
    const std::int64_t area = std::int64_t{op.window.size} * op.window.size;
    const bool fits = count(of(1)) == of(0)[0] * area && count(of(2)) == of(0)[0];
    return places(op.window, fits && op.window.padding >= 0, 1);
  }
  ShapeCheck operator()(const op::ChannelAttention& op) const {
    if (!has(3) || !floats() || op.n_group < 1) return {false};
    const bool fits = of(0)[0] % op.n_group == 0 && of(0)[0] / op.n_group <= op::ChannelAttention::kMaxGroup;
    return same_as_first(fits && of(0)[3] == 1 && of(1) == of(0) && of(2) == of(0));
  }
  /// A column of `area` * d values for each place of the window.
  ShapeCheck places(const op::Window& w, bool fits, std::int64_t area) const {
    if (in.empty() || !has(in.size()) || !floats() || !fits || w.size < 1 || w.stride < 1) return {false};
    const auto n_place = [&](std::int64_t n) {
      return n + 2 * w.padding < w.size ? 0 : (n + 2 * w.padding - w.size) / w.stride + 1;
    };
    const std::int64_t n_column = n_place(of(0)[1]), n_row = n_place(of(0)[2]);
    return {n_column > 0 && n_row > 0, {of(0)[0] * area, n_column, n_row, of(0)[3]}};
  }
  ShapeCheck operator()(const op::Write& op) const {
    return has(1) && of(0) == op.slot->shape && in[0].node()->type == op.slot->type ? same_as_first(true)
                                                                                    : ShapeCheck{false};
  }
};

}  // namespace

ShapeCheck check_shapes(const Op& op, const std::vector<Tensor>& in, const Shape& asked) {
  return std::visit(Rules{in, asked}, op);
}

}  // namespace vla
