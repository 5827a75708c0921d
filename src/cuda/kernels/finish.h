// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/device.h"
#include "cuda/kernels/epilogue.h"

namespace vla::cuda {

/// Neutral operands, which replace those that an epilogue lacks. x + -0 is x for every x, also for zeros of both
/// signs.
constexpr float kAddsNothing = -0.0f, kScalesNothing = 1;

VLA_DEVICE bool is_sigmoid(Activation activation) {
  return activation == Activation::silu || activation == Activation::gelu_tanh;
}
/// x / (1 + e^-u). With u = x this is SiLU; since 1 + tanh(u / 2) = 2 / (1 + e^-u), it also gives GELU's tanh form.
VLA_DEVICE float activate_by_sigmoid(Activation activation, float x) {
  const float u = activation == Activation::silu ? x : 1.5957691216f * (x + 0.044715f * x * x * x);
  return x * dev::reciprocal(1 + expf(-u));
}
VLA_DEVICE float activate_otherwise(Activation activation, float x) {
  if (activation == Activation::relu) return x < 0 ? 0 : x;
  if (activation == Activation::relu_squared) return x < 0 ? 0 : x * x;
  if (activation == Activation::gelu_erf) return 0.5f * x * (1 + erff(0.70710678f * x));
  // mish, as in kernels/math.h
  const float t = expf(-fabsf(x)), above = x < 0 ? t * (t + 2) : 1 + 2 * t;
  return x * (above * dev::reciprocal(above + (x < 0 ? 2 : 2 * t * t)));
}
/// Within a few units in the last place. Written without a switch, because nvcc would build a jump table at every use.
/// Uses a reciprocal, because a division branches, and an epilogue's many values would branch one after the other.
/// Sources: torch silu, gelu, relu, mish.
VLA_DEVICE float activate(Activation activation, float x) {
  if (activation == Activation::none) return x;
  return is_sigmoid(activation) ? activate_by_sigmoid(activation, x) : activate_otherwise(activation, x);
}

/// Calls run(activate), compiled separately for each kind of activation that most networks use, or otherwise(activate).
/// Shared code would skip instructions; those are fetched nevertheless, which costs more than computing a value.
template <class Run, class Otherwise>
VLA_DEVICE void with_activation(Activation activation, Run run, Otherwise otherwise) {
  if (activation == Activation::none)
    run([](float x) { return x; });
  else if (is_sigmoid(activation))
    run([=](float x) { return activate_by_sigmoid(activation, x); });
  else
    otherwise([=](float x) { return activate_otherwise(activation, x); });
}

/// Four adjacent elements of a row; the first n exist. `together`: all four exist and are aligned to their total size.
struct Four {
  float of[4];
};
VLA_DEVICE Four load_four(const float* from, bool together, int n) {
  Four to = {};
  if (together) {
    const float4 four = *reinterpret_cast<const float4*>(from);
    to.of[0] = four.x, to.of[1] = four.y, to.of[2] = four.z, to.of[3] = four.w;
  } else {
#pragma unroll
    for (int i = 0; i < 4; ++i)
      if (i < n) to.of[i] = from[i];
  }
  return to;
}
VLA_DEVICE void store_four(unsigned* to, const unsigned (&from)[4], bool together, int n) {
  if (together) {
    *reinterpret_cast<uint4*>(to) = uint4{from[0], from[1], from[2], from[3]};
  } else {
#pragma unroll
    for (int i = 0; i < 4; ++i)
      if (i < n) to[i] = from[i];
  }
}
VLA_DEVICE void store_four(std::uint16_t* to, const Four& from, bool together, int n) {
  const unsigned low = dev::to_bf16(from.of[0], from.of[1]), high = dev::to_bf16(from.of[2], from.of[3]);
  if (together) {
    *reinterpret_cast<uint2*>(to) = uint2{low, high};
  } else {
    const unsigned pairs[2] = {low, high};
#pragma unroll
    for (int i = 0; i < 4; ++i)
      if (i < n) to[i] = static_cast<std::uint16_t>(pairs[i / 2] >> i % 2 * 16);
  }
}

/// An epilogue's operands for two adjacent columns of a row, which are loaded before the sums are ready.
struct PairEnds {
  float2 bias = {kAddsNothing, kAddsNothing}, factor = {kScalesNothing, kScalesNothing}, gate = {0, 0};
  float2 residual = {kAddsNothing, kAddsNothing};
  bool has_second = false, has_gate = false;
};
VLA_DEVICE PairEnds load_ends(const Epilogue& e, std::int64_t row, int column, int n_column) {
  PairEnds ends;
  ends.has_second = column + 1 < n_column, ends.has_gate = e.gate != nullptr;
  const auto load = [&](const float* from, std::int64_t at, float2& to) {
    if (from == nullptr) return;
    if (at % 2 == 0 && ends.has_second && reinterpret_cast<std::uint64_t>(from) % 8 == 0) {
      to = *reinterpret_cast<const float2*>(from + at);
    } else {
      to.x = from[at];
      if (ends.has_second) to.y = from[at + 1];
    }
  };
  const std::int64_t at = row * n_column + column;
  load(e.bias, column, ends.bias), load(e.factor, column, ends.factor);
  load(e.gate, at, ends.gate), load(e.residual, at, ends.residual);
  return ends;
}

/// Computes y from one sum; activate(x) is the activation. Products and sums are not fused, so y without an activation
/// equals the CPU's to the bit.
template <class Activate>
VLA_DEVICE float finish(const Epilogue& e, bool has_gate, float sum, float bias, float factor, float gate,
                        float residual, Activate activate) {
  sum = dev::add(sum, bias);
  const float activated = activate(has_gate ? gate : sum);
  sum = dev::multiply(has_gate ? dev::multiply(activated, sum) : activated, factor);
  sum = dev::add(sum, residual);
  return e.ends_in_relu && sum < 0 ? 0 : sum;
}

/// Writes y of four adjacent columns from `column` on; the first n exist.
VLA_DEVICE void store_y(const Epilogue& e, std::int64_t row, int column, const Four& y, bool together, int n) {
  const std::int64_t at = row * e.y_stride + column;
  if (e.is_bf16) return store_four(static_cast<std::uint16_t*>(e.y) + at, y, together, n);
  const unsigned words[4] = {static_cast<unsigned>(dev::bits_of(y.of[0])), static_cast<unsigned>(dev::bits_of(y.of[1])),
                             static_cast<unsigned>(dev::bits_of(y.of[2])),
                             static_cast<unsigned>(dev::bits_of(y.of[3]))};
  store_four(static_cast<unsigned*>(e.y) + at, words, together, n);
}

/// Whether all operands of an epilogue, and y, consist of aligned fours.
VLA_DEVICE bool is_of_fours(const Epilogue& e, int n_column) {
  const auto bits = [](const void* p) { return reinterpret_cast<std::uint64_t>(p); };
  const auto all = bits(e.bias) | bits(e.factor) | bits(e.gate) | bits(e.residual) | bits(e.y);
  return (n_column | e.y_stride) % 4 == 0 && all % 16 == 0;
}
/// Computes and stores y of four adjacent sums from `column` on, with a gate if has_gate.
template <bool kTogether>
VLA_DEVICE void finish_four(const Epilogue& e, int row, int column, int n_column, const Four& sum, bool has_gate,
                            const Four& gate) {
  const int n = n_column - column;
  const auto load = [&](const float* from, std::int64_t at, float otherwise) {
    return from ? load_four(from + at, kTogether, n) : Four{{otherwise, otherwise, otherwise, otherwise}};
  };
  const Four bias = load(e.bias, column, kAddsNothing), factor = load(e.factor, column, kScalesNothing);
  const Four residual = load(e.residual, static_cast<std::int64_t>(row) * n_column + column, kAddsNothing);
  Four y;
  const auto run = [&](auto activate) {
#pragma unroll
    for (int c = 0; c < 4; ++c)
      y.of[c] = finish(e, has_gate, sum.of[c], bias.of[c], factor.of[c], gate.of[c], residual.of[c], activate);
  };
  with_activation(e.activation, run, run);
  store_y(e, row, column, y, kTogether, n);
}

/// Writes y of two adjacent columns; without has_second the second is after the last column.
VLA_DEVICE void store_y(const Epilogue& e, std::int64_t row, int column, float first, float second, bool has_second) {
  const std::int64_t at = row * e.y_stride + column;
  const bool together = has_second && e.y_stride % 2 == 0;
  if (e.is_bf16) {
    const unsigned pair = dev::to_bf16(first, second);
    auto* y = static_cast<std::uint16_t*>(e.y) + at;
    if (together) {
      *reinterpret_cast<unsigned*>(y) = pair;
    } else {
      y[0] = static_cast<std::uint16_t>(pair);
      if (has_second) y[1] = static_cast<std::uint16_t>(pair >> 16);
    }
  } else {
    auto* y = static_cast<float*>(e.y) + at;
    if (together) {
      *reinterpret_cast<float2*>(y) = float2{first, second};
    } else {
      y[0] = first;
      if (has_second) y[1] = second;
    }
  }
}

/// Stores and returns y of two adjacent sums; the second may be after the last column.
VLA_DEVICE float2 finish_pair(const Epilogue& e, const PairEnds& ends, float first, float second, std::int64_t row,
                              int column) {
  const auto activated = [&](float x) { return activate(e.activation, x); };
  first = finish(e, ends.has_gate, first, ends.bias.x, ends.factor.x, ends.gate.x, ends.residual.x, activated);
  second = finish(e, ends.has_gate, second, ends.bias.y, ends.factor.y, ends.gate.y, ends.residual.y, activated);
  store_y(e, row, column, first, second, ends.has_second);
  return {first, second};
}
VLA_DEVICE void finish_pair(const Epilogue& e, float first, float second, std::int64_t row, int column, int n_column) {
  finish_pair(e, load_ends(e, row, column, n_column), first, second, row, column);
}

/// Rotates pairs of elements of a head, whose first and second elements are low and high.
template <int kCount>
VLA_DEVICE void rotate(float (&low)[kCount], float (&high)[kCount], const float* cosine, const float* sine) {
#pragma unroll
  for (int i = 0; i < kCount; ++i) {
    const float first = low[i], second = high[i];
    low[i] = first * cosine[i] - second * sine[i], high[i] = second * cosine[i] + first * sine[i];
  }
}

}  // namespace vla::cuda
