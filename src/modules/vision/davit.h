// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "modules/attention.h"
#include "nn/convolution.h"
#include "nn/mlp.h"

namespace vla {

/// Cuts a map of cells into windows of size x size cells, from the upper left. The reference pads the map with zeros
/// before the projections of attention, so padding cells are keys and values too, all equal to the biases. One key with
/// the logarithm of their count in the mask stands for all of a window's padding cells.
class Windows {
 public:
  Windows(int n_column, int n_row, int size);

  /// Windows with the same number of cells of the map.
  struct Kind {
    int n_cell;             // cells of the map in one window
    int n_beyond;           // padding cells in a window
    std::vector<int> cell;  // cells of all these windows in order: row * n_column + column
  };
  const std::vector<Kind>& kinds() const { return kinds_; }
  bool reach_beyond() const;
  /// x [d, n, n_view] -> [d, n * n_view], tokens ordered by kind, view and window.
  Tensor cut(Graph& g, Tensor x) const;
  /// The inverse of `cut`. `like` is the tensor that was cut; the result has its shape.
  Tensor join(Graph& g, Tensor x, Tensor like) const;

 private:
  std::vector<std::int32_t> order(int n_view) const;  // the index in x of each token of `cut`
  int n_column_, n_row_, size_;
  std::vector<Kind> kinds_;
};

/// The projections to queries, keys and values, and the output projection, with biases.
struct AttentionProducts {
  AttentionProducts(const Scope& s, int d_model);
  Linear q, k, v, out;
};

/// Sizes of a stage's blocks.
struct DavitStage {
  int d_model, n_head, n_group, d_ff, n_column, n_row, window;
  float norm_eps;
};

/// The structure of both kinds of blocks: x + conv(x), attention, x + conv(x), MLP. Source: transformers
/// modeling_florence2.py Florence2VisionSpatialBlock, Florence2VisionChannelBlock.
class DavitBlock {
 public:
  DavitBlock(const Scope& s, const DavitStage& stage);
  /// x [d_model, n_column, n_row, n_view] -> the same shape; `attend` gets normalized tokens [d_model, n, n_view].
  template <class Attend>
  Tensor operator()(Graph& g, Tensor x, const Attend& attend) const;

 private:
  DepthwiseConvolution conv1_;
  LayerNorm attn_norm_;
  DepthwiseConvolution conv2_;
  LayerNorm ffn_norm_;
  Mlp mlp_;
};

/// Cells of a window attend to each other. Source: Florence2VisionSpatialBlock.
class SpatialBlock : public Module<SpatialBlock> {
 public:
  SpatialBlock(const Scope& s, const DavitStage& stage);
  Tensor forward(Graph& g, Tensor x, const Cache& cache) const;
  /// Load rate: key and value of a padding cell.
  void keep(Graph& g, Cache& cache) const;

 private:
  Tensor attend(Graph& g, Tensor x, const Cache& cache) const;
  int d_model_, n_head_;
  Windows windows_;
  DavitBlock block_;
  AttentionProducts products_;
};

/// Features of a group attend to each other. Source: Florence2VisionChannelBlock.
class ChannelBlock : public Module<ChannelBlock> {
 public:
  ChannelBlock(const Scope& s, const DavitStage& stage);
  Tensor forward(Graph& g, Tensor x) const;

 private:
  int n_group_;
  DavitBlock block_;
  AttentionProducts products_;
};

/// A strided convolution that shrinks the map, with a norm before or after it. Source: Florence2VisionConvEmbed.
class ConvEmbed : public Module<ConvEmbed> {
 public:
  ConvEmbed(const Scope& s, int d_in, int d_out, int size, int stride, bool pre_norm, float eps);
  Tensor forward(Graph& g, Tensor x) const;

 private:
  bool pre_norm_;
  LayerNorm norm_;
  Convolution convolution_;
};

/// DaViT: stages of alternating spatial and channel blocks. Source: transformers modeling_florence2.py
/// Florence2VisionBackbone.
class Davit {
 public:
  /// Reads the lists d_model, n_layer, n_head, n_group, d_ff, patch_size, patch_stride and pre_norm, with one number
  /// per stage, and window, image_width, image_height and norm_eps.
  explicit Davit(const Scope& s);

  /// images [width, height, 3, n_view], standardized -> [d_model, n_column, n_row, n_view].
  Tensor operator()(Graph& g, Tensor images, const Cache& cache) const;
  /// Load rate: keys and values of padding cells, for all spatial blocks.
  void keep(Graph& g, Cache& cache) const;
  /// Checks that images have the size of the keys. Errors: unsupported.
  Status check(int width, int height) const;

  int d_model() const { return d_model_; }  // channels of the last stage
  int n_head() const { return n_head_; }
  int n_column() const { return n_column_; }
  int n_row() const { return n_row_; }

 private:
  struct Stage {
    ConvEmbed embed;
    std::vector<SpatialBlock> spatial;
    std::vector<ChannelBlock> channel;
  };
  int width_, height_;
  int d_model_ = 3, n_head_ = 1, n_column_, n_row_;
  std::vector<Stage> stages_;
};

}  // namespace vla
