// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/davit.h"

#include <fmt/format.h>

#include <algorithm>
#include <map>

#include "nn/embedding.h"

namespace vla {
namespace {

constexpr int kMaxStage = 8;

/// Reshapes a map of cells to tokens and back: [d, n_column, n_row, n_view], [d, n, n_view].
Tensor as_tokens(Graph& g, Tensor x) { return g.add(op::Reshape{}, {x}, {x.dim(0), x.dim(1) * x.dim(2), x.dim(3), 1}); }
Tensor shaped_like(Graph& g, Tensor x, Tensor like) { return g.add(op::Reshape{}, {x}, like.shape()); }

}  // namespace

Windows::Windows(int n_column, int n_row, int size) : n_column_(n_column), n_row_(n_row), size_(size) {
  std::map<std::pair<int, int>, Kind> by_size;
  for (int row = 0; row < n_row; row += size)
    for (int column = 0; column < n_column; column += size) {
      const int width = std::min(size, n_column - column), height = std::min(size, n_row - row);
      Kind& kind = by_size[{height, width}];
      kind.n_cell = width * height, kind.n_beyond = size * size - kind.n_cell;
      for (int y = row; y < row + height; ++y)
        for (int x = column; x < column + width; ++x) kind.cell.push_back(y * n_column + x);
    }
  for (auto& [_, kind] : by_size) kinds_.push_back(std::move(kind));
}

bool Windows::reach_beyond() const {
  return std::any_of(kinds_.begin(), kinds_.end(), [](const Kind& kind) { return kind.n_beyond > 0; });
}

std::vector<std::int32_t> Windows::order(int n_view) const {
  std::vector<std::int32_t> from;
  for (const Kind& kind : kinds_)
    for (int view = 0; view < n_view; ++view)
      for (const int cell : kind.cell) from.push_back(view * n_column_ * n_row_ + cell);
  return from;
}

Tensor Windows::cut(Graph& g, Tensor x) const {
  const int n_view = static_cast<int>(x.dim(2));
  const std::string key = fmt::format("windows/{}/{}/{}/{}", n_column_, n_row_, size_, n_view);
  return g.add(op::Gather{}, {flatten_views(g, x), constant_ids(g, key, order(n_view))});
}

Tensor Windows::join(Graph& g, Tensor x, Tensor like) const {
  const int n_view = static_cast<int>(like.dim(2));
  const std::vector<std::int32_t> from = order(n_view);
  std::vector<std::int32_t> to(from.size());
  for (std::size_t i = 0; i < from.size(); ++i) to[static_cast<std::size_t>(from[i])] = static_cast<std::int32_t>(i);
  const std::string key = fmt::format("windows back/{}/{}/{}/{}", n_column_, n_row_, size_, n_view);
  return shaped_like(g, g.add(op::Gather{}, {x, constant_ids(g, key, to)}), like);
}

AttentionProducts::AttentionProducts(const Scope& s, int d_model)
    : q(s / "attn_q", d_model, d_model, Bias::yes),
      k(s / "attn_k", d_model, d_model, Bias::yes),
      v(s / "attn_v", d_model, d_model, Bias::yes),
      out(s / "attn_out", d_model, d_model, Bias::yes) {}

DavitBlock::DavitBlock(const Scope& s, const DavitStage& stage)
    : conv1_(s / "conv1", stage.d_model, 3),
      attn_norm_(s / "attn_norm", stage.d_model, stage.norm_eps),
      conv2_(s / "conv2", stage.d_model, 3),
      ffn_norm_(s / "ffn_norm", stage.d_model, stage.norm_eps),
      mlp_(s, stage.d_model, stage.d_ff, Activation::gelu_erf) {}

template <class Attend>
Tensor DavitBlock::operator()(Graph& g, Tensor x, const Attend& attend) const {
  const Tensor placed = add(g, conv1_(g, x), x);
  const Tensor tokens = as_tokens(g, placed);
  const Tensor seen = shaped_like(g, add(g, tokens, attend(attn_norm_(g, tokens))), x);
  const Tensor moved = add(g, conv2_(g, seen), seen);
  return add(g, moved, mlp_(g, ffn_norm_(g, moved)));
}

SpatialBlock::SpatialBlock(const Scope& s, const DavitStage& stage)
    : Module(s),
      d_model_(stage.d_model),
      n_head_(stage.n_head),
      windows_(stage.n_column, stage.n_row, stage.window),
      block_(s, stage),
      products_(s, stage.d_model) {}

void SpatialBlock::keep(Graph& g, Cache& cache) const {
  if (!windows_.reach_beyond()) return;
  const Tensor zero = full(g, 0.0f, d_model_, 1);
  put(g, cache, path() + ".beyond",
      {split_heads(g, products_.k.forward(g, zero), n_head_), split_heads(g, products_.v.forward(g, zero), n_head_)});
}

Tensor SpatialBlock::forward(Graph& g, Tensor x, const Cache& cache) const {
  return block_(g, x, [&](Tensor tokens) { return attend(g, tokens, cache); });
}

Tensor SpatialBlock::attend(Graph& g, Tensor x, const Cache& cache) const {
  const Tensor cells = windows_.cut(g, x);
  const Tensor q = products_.q(g, cells), k = products_.k(g, cells), v = products_.v(g, cells);
  const int n_view = static_cast<int>(x.dim(2));
  std::vector<Tensor> seen;
  int first = 0;
  for (const Windows::Kind& kind : windows_.kinds()) {
    const int n = static_cast<int>(kind.cell.size()) * n_view, n_window = n / kind.n_cell;
    const auto heads = [&](Tensor rows) {
      return g.add(op::Reshape{}, {slice_tokens(g, rows, first, n)},
                   {rows.dim(0) / n_head_, n_head_, kind.n_cell, n_window});
    };
    std::vector<KeyValue> segments = {{heads(k), heads(v)}};
    std::vector<int> copies(static_cast<std::size_t>(kind.n_cell), 1);
    if (kind.n_beyond > 0) {
      const KeyValue one = get(g, cache, path() + ".beyond");
      const auto of_all = [&](Tensor rows) { return g.add(op::Repeat{}, {rows}, {rows.dim(0), n_head_, 1, n_window}); };
      segments.push_back({of_all(one.key), of_all(one.value)});
      copies.push_back(kind.n_beyond);
    }
    seen.push_back(flatten_views(g, attention(g, heads(q), segments, copies_mask(g, copies, kind.n_cell))));
    first += n;
  }
  return windows_.join(g, products_.out(g, concat_tokens(g, seen)), x);
}

ChannelBlock::ChannelBlock(const Scope& s, const DavitStage& stage)
    : Module(s), n_group_(stage.n_group), block_(s, stage), products_(s, stage.d_model) {}

Tensor ChannelBlock::forward(Graph& g, Tensor x) const {
  return block_(g, x, [&](Tensor tokens) {
    const Tensor q = products_.q(g, tokens), k = products_.k(g, tokens), v = products_.v(g, tokens);
    return products_.out(g, g.add(op::ChannelAttention{n_group_}, {q, k, v}));
  });
}

ConvEmbed::ConvEmbed(const Scope& s, int d_in, int d_out, int size, int stride, bool pre_norm, float eps)
    : Module(s),
      pre_norm_(pre_norm),
      norm_(s / "norm", pre_norm ? d_in : d_out, eps),
      convolution_(s / "conv", d_in, d_out, size, stride) {}

Tensor ConvEmbed::forward(Graph& g, Tensor x) const {
  return pre_norm_ ? convolution_(g, norm_(g, x)) : norm_(g, convolution_(g, x));
}

Davit::Davit(const Scope& s)
    : width_(s.dim("image_width", 4096)), height_(s.dim("image_height", 4096)), n_column_(width_), n_row_(height_) {
  const std::vector<int> widths = s.integers("d_model", {1, 1 << 16});
  const std::size_t n_stage = std::clamp<std::size_t>(widths.size(), 1, kMaxStage);
  const auto of_stages = [&](const std::string& key, Range range) {
    std::vector<int> numbers = s.integers(key, range);
    s.require(numbers.size() == n_stage, key, fmt::format("a number for each of {} stages", n_stage),
              std::to_string(numbers.size()));
    numbers.resize(n_stage, 1);
    return numbers;
  };
  const std::vector<int> d_model = of_stages("d_model", {1, 1 << 16}), n_layer = of_stages("n_layer", {1, 512}),
                         n_head = of_stages("n_head", {1, 1024}), n_group = of_stages("n_group", {1, 1024}),
                         d_ff = of_stages("d_ff", {1, 1 << 16}), size = of_stages("patch_size", {1, 255}),
                         stride = of_stages("patch_stride", {1, 255}), pre_norm = of_stages("pre_norm", {0, 1});
  const int window = s.dim("window", 1024);
  const float eps = s.number("norm_eps", kNormEps);
  for (std::size_t i = 0; i < n_stage; ++i) {
    const Scope here = s / "stage" / static_cast<int>(i);
    s.require(size[i] % 2 == 1, "patch_size", "odd numbers", std::to_string(size[i]));
    s.require(d_model[i] % n_head[i] == 0, "n_head", fmt::format("a divisor of d_model {}", d_model[i]),
              std::to_string(n_head[i]));
    constexpr int kMaxGroup = op::ChannelAttention::kMaxGroup;
    s.require(d_model[i] % n_group[i] == 0 && d_model[i] / n_group[i] <= kMaxGroup, "n_group",
              fmt::format("a divisor of d_model {} that leaves at most {}", d_model[i], kMaxGroup),
              std::to_string(n_group[i]));
    Stage& stage = stages_.emplace_back(
        Stage{ConvEmbed(here / "embed", d_model_, d_model[i], size[i], stride[i], pre_norm[i] == 1, eps), {}, {}});
    const auto places = [&](int n) { return (n + size[i] / 2 * 2 - size[i]) / stride[i] + 1; };
    d_model_ = d_model[i], n_head_ = n_head[i], n_column_ = places(n_column_), n_row_ = places(n_row_);
    const DavitStage sizes = {.d_model = d_model_,
                              .n_head = n_head_,
                              .n_group = n_group[i],
                              .d_ff = d_ff[i],
                              .n_column = n_column_,
                              .n_row = n_row_,
                              .window = window,
                              .norm_eps = eps};
    for (int b = 0; b < n_layer[i]; ++b) {
      stage.spatial.emplace_back(here / "blk" / b / "spatial", sizes);
      stage.channel.emplace_back(here / "blk" / b / "channel", sizes);
    }
  }
}

Status Davit::check(int width, int height) const {
  if (width == width_ && height == height_) return {};
  return Error{Code::unsupported, "vision.image_width", fmt::format("images of {} x {}", width_, height_),
               fmt::format("{} x {}", width, height)};
}

void Davit::keep(Graph& g, Cache& cache) const {
  for (const Stage& stage : stages_)
    for (const SpatialBlock& block : stage.spatial) block.keep(g, cache);
}

Tensor Davit::operator()(Graph& g, Tensor images, const Cache& cache) const {
  Tensor x = pixels_first(g, images);
  for (const Stage& stage : stages_) {
    x = stage.embed(g, x);
    for (std::size_t i = 0; i < stage.spatial.size(); ++i) x = stage.channel[i](g, stage.spatial[i](g, x, cache));
  }
  return x;
}

}  // namespace vla
