// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>
#include <vector>

#include "graph/cache.h"
#include "nn/convolution.h"
#include "nn/group_norm.h"

namespace vla {

/// The options that all blocks of a U-Net share.
struct UnetFamily {
  int kernel_size, n_group;
  float norm_eps;
  bool scales;                // FiLM multiplies before it adds
  int d_time, d_observation;  // widths of the condition's two parts

  /// Reads `kernel_size`, `n_group`, `norm_eps`, `film` and `d_time`.
  static UnetFamily read(const Scope& s, int d_observation);
};

/// mish(norm(convolution(x))), over tokens [d, n]. Source: lerobot modeling_diffusion.py DiffusionConv1dBlock.
class UnetConvolution {
 public:
  UnetConvolution(const Scope& s, const Scope& norm, int d_in, int d_out, const UnetFamily& family);
  Tensor operator()(Graph& g, Tensor x) const;

 private:
  TokenConvolution convolution_;
  GroupNorm norm_;
};

/// Two convolutions with FiLM between them, and a shortcut around both. FiLM is linear in the condition, which is made
/// of time and observation, so each one's share is computed at its own rate and the shares are added. Source: lerobot
/// modeling_diffusion.py DiffusionConditionalResidualBlock1d.
class UnetBlock : public Module<UnetBlock> {
 public:
  UnetBlock(const Scope& s, int d_in, int d_out, const UnetFamily& family);
  /// Rows of FiLM.
  int d_film() const { return scales_ ? 2 * d_out_ : d_out_; }
  /// The share of the time, one column per step: [d_time, n] -> [d_film, n].
  Tensor of_time(Graph& g, Tensor time) const { return film_time_(g, time); }
  /// The share of the observation: [d_observation, 1] -> [d_film, 1].
  Tensor of_observation(Graph& g, Tensor observation) const { return film_observation_(g, observation); }
  /// x [d_in, n], film [d_film, 1] -> [d_out, n].
  Tensor forward(Graph& g, Tensor x, Tensor film) const;

 private:
  int d_out_;
  bool scales_;
  UnetConvolution first_, second_;
  Linear film_time_, film_observation_;
  std::optional<Linear> shortcut_;
};

/// A U-Net over the rows of a chunk. `widths` has the width of each level; a level has half as many tokens as the one
/// before. Source: lerobot modeling_diffusion.py DiffusionConditionalUnet1d.
class Unet {
 public:
  /// Reads `widths` and the keys of UnetFamily.
  Unet(const Scope& s, int d_action, int d_observation);
  int d_time() const { return family_.d_time; }
  /// The number of rows of a chunk must be a multiple of the stride.
  int stride() const { return 1 << (static_cast<int>(widths_.size()) - 1); }

  /// Load rate: the time's share of every block, one column per step: [d_time, n] -> [d, n].
  Tensor condition(Graph& g, Tensor time) const;
  /// Observation rate: puts the observation's share of every block into the cache. observation [d_observation, 1].
  void prefix(Graph& g, Tensor observation, Cache& cache) const;
  /// Step rate: x [d_action, n] -> the same shape. `condition`: one column of the function `condition`.
  Tensor operator()(Graph& g, Tensor x, Tensor condition, const Cache& cache) const;

 private:
  UnetFamily family_;
  std::vector<int> widths_;
  std::vector<UnetBlock> blocks_;  // two of each level downwards, two at the bottom, two of each level upwards
  std::vector<HalvingConvolution> down_;
  std::vector<DoublingConvolution> up_;
  UnetConvolution out_;
  Linear action_out_;
};

}  // namespace vla
