// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/action/unet.h"

#include <fmt/format.h>

#include "nn/tokens.h"

namespace vla {
namespace {

constexpr int kMaxLevels = 12, kMaxKernel = 255, kMaxWidth = 16384;
constexpr int kOutGroups = 8;  // groups of the last norm, independent of `n_group`

std::vector<int> read_widths(const Scope& s) {
  std::vector<int> widths = s.integers("widths", {1, kMaxWidth});
  s.require(!widths.empty() && widths.size() <= kMaxLevels, "widths", fmt::format("1 to {} widths", kMaxLevels),
            std::to_string(widths.size()));
  if (widths.empty() || widths.size() > kMaxLevels) widths.assign(1, kOutGroups);
  return widths;
}

}  // namespace

UnetFamily UnetFamily::read(const Scope& s, int d_observation) {
  UnetFamily family = {s.dim("kernel_size", kMaxKernel),
                       s.dim("n_group"),
                       s.number("norm_eps", kNormEps),
                       s.choice("film", {"shift", "scale_shift"}) == 1,
                       s.dim("d_time"),
                       d_observation};
  s.require(family.kernel_size % 2 == 1, "kernel_size", "an odd number", std::to_string(family.kernel_size));
  s.require(family.d_time % 2 == 0 && family.d_time >= 4, "d_time", "an even number of 4 or more",
            std::to_string(family.d_time));
  return family;
}

UnetConvolution::UnetConvolution(const Scope& s, const Scope& norm, int d_in, int d_out, const UnetFamily& family)
    : convolution_(s, d_in, d_out, family.kernel_size), norm_(norm, d_out, family.n_group, family.norm_eps) {}

Tensor UnetConvolution::operator()(Graph& g, Tensor x) const {
  const Tensor y = convolution_(g, x);  // [d, n], which GroupNorm reads as one view with a single row
  return activate(g, norm_(g, y), Activation::mish);
}

UnetBlock::UnetBlock(const Scope& s, int d_in, int d_out, const UnetFamily& family)
    : Module(s),
      d_out_(d_out),
      scales_(family.scales),
      first_(s / "conv1", s / "norm1", d_in, d_out, family),
      second_(s / "conv2", s / "norm2", d_out, d_out, family),
      film_time_(s / "film_time", family.d_time, d_film(), Bias::yes),
      film_observation_(s / "film_observation", family.d_observation, d_film(), Bias::no) {
  if (d_in != d_out) shortcut_.emplace(s / "shortcut", d_in, d_out, Bias::yes);
}

Tensor UnetBlock::forward(Graph& g, Tensor x, Tensor film) const {
  Tensor y = first_(g, x);
  if (scales_) y = multiply(g, y, slice_features(g, film, 0, d_out_));
  y = second_(g, add(g, y, slice_features(g, film, d_film() - d_out_, d_out_)));
  return add(g, y, shortcut_ ? (*shortcut_)(g, x) : x);
}

Unet::Unet(const Scope& s, int d_action, int d_observation)
    : family_(UnetFamily::read(s, d_observation)),
      widths_(read_widths(s)),
      out_(s / "out", s / "out_norm", widths_.front(), widths_.front(),
           {family_.kernel_size, kOutGroups, family_.norm_eps, false, 0, 0}),
      action_out_(s / "action_out", widths_.front(), d_action, Bias::yes) {
  const auto add_pair = [&](int d_in, int d_out) {
    for (const int d : {d_in, d_out})
      blocks_.emplace_back(s / "blk" / static_cast<int>(blocks_.size()), d, d_out, family_);
  };
  const int n_level = static_cast<int>(widths_.size());
  const auto width = [&](int level) { return level < 0 ? d_action : widths_[static_cast<std::size_t>(level)]; };
  for (int level = 0; level < n_level; ++level) add_pair(width(level - 1), width(level));
  add_pair(width(n_level - 1), width(n_level - 1));
  for (int level = n_level - 1; level > 0; --level) add_pair(2 * width(level), width(level - 1));
  for (int level = 0; level + 1 < n_level; ++level) {
    down_.emplace_back(s / "down" / level, width(level));
    up_.emplace_back(s / "up" / level, width(n_level - 2 - level));
  }
}

Tensor Unet::condition(Graph& g, Tensor time) const {
  std::vector<Tensor> shares;
  for (const UnetBlock& block : blocks_) shares.push_back(block.of_time(g, time));
  return concat(g, shares, 0);
}

void Unet::prefix(Graph& g, Tensor observation, Cache& cache) const {
  for (const UnetBlock& block : blocks_) cache.put(g, block.path() + ".film", block.of_observation(g, observation));
}

Tensor Unet::operator()(Graph& g, Tensor x, Tensor condition, const Cache& cache) const {
  const std::size_t n_level = widths_.size();
  std::vector<Tensor> levels;
  int first = 0;  // first row of the block's share in the condition
  auto block = blocks_.begin();
  const auto pass = [&](Tensor y) {
    for (const auto end = block + 2; block != end; first += block->d_film(), ++block) {
      const Tensor of_time = slice_features(g, condition, first, block->d_film());
      y = (*block)(g, y, add(g, of_time, cache.get(g, block->path() + ".film")));
    }
    return y;
  };
  for (std::size_t level = 0; level < n_level; ++level) {
    levels.push_back(x = pass(x));
    if (level + 1 < n_level) x = down_[level](g, x);
  }
  x = pass(x);
  for (std::size_t level = 0; level + 1 < n_level; ++level)
    x = up_[level](g, pass(concat_features(g, x, levels[n_level - 1 - level])));
  return action_out_(g, out_(g, x));
}

}  // namespace vla
