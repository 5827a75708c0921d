// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "bundle/params.h"
#include "graph/graph.h"

namespace vla {

/// The time of a solver step: as the reference's network gets it, and in double before it is rounded to float32.
struct SolverTime {
  float value;
  double exact;
};

/// Sines, then cosines, of times at geometrically spaced periods: [d, n_time], one column per time. `d` is even. The
/// times are float32 and everything after is double, as in the reference: in float32 the shortest period would cost
/// 1e-4. Source: lerobot policies/common/vla_utils.py create_sinusoidal_pos_embedding.
std::vector<float> sinusoidal_time_embedding(std::span<const float> times, int d, double min_period, double max_period);

/// The solver's times as a policy embeds them, with the periods of `<path>.min_period` and `<path>.max_period`.
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
///                  SinusoidalPositionalEncoding, which rounds exponents as cosines_first: their last bit)
///   sines_first    P = 10000, m = n (lerobot policies/groot/groot_n1_7.py SinusoidalPositionalEncoding)
///   slow_cosines   P = 100, m = n, cosines first (lerobot policies/xvla/soft_transformer.py timestep_embedding)
/// The exponents are rounded as each rounds them: at t = 750 an exponent's last bit turns an angle by 5e-5.
enum class TimeWaves { cosines_first, sines_to_last, sines_first, slow_cosines };

/// Values of [d, times.size()], one column per time. An odd d ends in a zero; `cosines_first` and `sines_to_last`
/// take d from 4 on.
std::vector<float> wave_embedding(std::span<const float> times, int d, TimeWaves waves);
/// Load rate: the same of the solver's times, [d, times.size()].
Tensor wave_embedding(Graph& g, std::span<const SolverTime> times, int d, TimeWaves waves);

}  // namespace vla
