// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "bundle/params.h"
#include "graph/graph.h"

namespace vla {

/// The time of a solver step: `value` in float32 as the reference's network receives it, `exact` in double before
/// rounding.
struct SolverTime {
  float value;
  double exact;
};

/// Sines, then cosines, of times at geometrically spaced periods: [d, n_time], one column per time. `d` is even. As in
/// the reference, the times are float32 and the rest is computed in double: in float32 the error at the shortest period
/// would be 1e-4. Source: lerobot policies/common/vla_utils.py create_sinusoidal_pos_embedding.
std::vector<float> sinusoidal_time_embedding(std::span<const float> times, int d, double min_period, double max_period);

/// Embeds the solver's times, with periods from `<path>.min_period` to `<path>.max_period`.
class TimestepEmbedding {
 public:
  /// `d`: width of an embedding, even.
  TimestepEmbedding(const Scope& s, int d);
  /// Load rate: one column per time, [d, times.size()].
  Tensor operator()(Graph& g, std::span<const SolverTime> times) const;

 private:
  int d_;
  double min_period_, max_period_;
};

/// How a reference embeds a time t: cosines or sines first, of n = d/2 float32 angles t * exp(-ln(P) i / m).
///   cosines_first  P = 10000, m = n - 1 (diffusers models/embeddings.py get_timestep_embedding, flip_sin_to_cos)
///   sines_to_last  P = 10000, m = n - 1, sines first (lerobot policies/diffusion/modeling_diffusion.py
///                  DiffusionSinusoidalPosEmb; openvla-oft prismatic/models/action_heads.py
///                  SinusoidalPositionalEncoding, which rounds exponents like cosines_first; the last bit differs)
///   sines_first    P = 10000, m = n (lerobot policies/groot/groot_n1_7.py SinusoidalPositionalEncoding)
///   slow_cosines   P = 100, m = n, cosines first (lerobot policies/xvla/soft_transformer.py timestep_embedding)
/// Exponents are rounded as in the first reference of each, because at t = 750 an exponent's last bit changes the angle
/// by 5e-5.
enum class TimeWaves { cosines_first, sines_to_last, sines_first, slow_cosines };

/// The values of a tensor [d, times.size()], one column per time. If d is odd, each column ends with a zero.
/// `cosines_first` and `sines_to_last` need d of 4 or more.
std::vector<float> wave_embedding(std::span<const float> times, int d, TimeWaves waves);
/// Load rate: the same for the solver's times, [d, times.size()].
Tensor wave_embedding(Graph& g, std::span<const SolverTime> times, int d, TimeWaves waves);

}  // namespace vla
