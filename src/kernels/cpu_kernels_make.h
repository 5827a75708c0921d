// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/attention_tile.h"
#include "kernels/cpu_kernels.h"
#include "kernels/gelu_erf.h"

namespace vla::kernels {

/// The kernels of one instruction set, all from the same templates. Include this only in a file compiled for V's
/// instructions. `Products`: a type of attention_products.h, for attention.
template <class Products>
class CpuKernelsMaker {
  using V = typename Products::Vector;
  using Float = typename V::Float;

 public:
  static constexpr CpuKernels make() {
    return {
        .silu = map<Silu>,
        .gelu_tanh = map<GeluTanh>,
        .gelu_erf = map<GeluErf>,
        .relu = map<Relu>,
        .relu_squared = map<ReluSquared>,
        .mish = map<Mish>,
        .layer_norm = layer_norm,
        .rms_norm = rms_norm,
        .rotate_half = rotate_half,
        .add = map<Plus>,
        .multiply = map<Times>,
        .largest = map<Larger>,
        .multiply_add = multiply_add,
        .scale = scaled,
        .attention = AttentionTile<Products>::kernel(),
        .channel_attention = channel_attention,
    };
  }

 private:
  struct Silu {
    static VLA_INLINE Float of(Float x, Float) { return silu<V>(x); }
  };
  struct GeluTanh {
    static VLA_INLINE Float of(Float x, Float) { return gelu_tanh<V>(x); }
  };
  struct GeluErf {
    static VLA_INLINE Float of(Float x, Float) { return gelu_erf<V>(x); }
  };
  struct Relu {
    static VLA_INLINE Float of(Float x, Float) { return relu<V>(x); }
  };
  struct ReluSquared {
    static VLA_INLINE Float of(Float x, Float) { return relu_squared<V>(x); }
  };
  struct Mish {
    static VLA_INLINE Float of(Float x, Float) { return mish<V>(x); }
  };

  struct Plus {
    static VLA_INLINE Float of(Float x, Float w) { return x + w; }
    static constexpr bool kBinary = true;
  };
  struct Times {
    static VLA_INLINE Float of(Float x, Float w) { return x * w; }
    static constexpr bool kBinary = true;
  };

  struct Larger {
    static VLA_INLINE Float of(Float x, Float w) { return ((x > w) | (x != x)) ? x : w; }
    static constexpr bool kBinary = true;
  };

  template <class F>
  static void map(const float* x, const float* w, const float*, float, float* y, std::int64_t n) {
    for (std::int64_t i = 0; i < n; i += V::width) {
      Float second = {};
      if constexpr (requires { F::kBinary; }) second = load<V>(w + i, n - i);
      store<V>(y + i, F::of(load<V>(x + i, n - i), second), n - i);
    }
  }

  static void channel_attention(const ChannelAttentionJob& job, std::int64_t unit) { attend_channels<V>(job, unit); }

  static void multiply_add(const float* x, const float* w, const float* b, float, float* y, std::int64_t n) {
    for (std::int64_t i = 0; i < n; i += V::width)
      store<V>(y + i, V::fma(load<V>(x + i, n - i), load<V>(w + i, n - i), load<V>(b + i, n - i)), n - i);
  }

  static void scaled(const float* x, const float*, const float*, float s, float* y, std::int64_t n) {
    for (std::int64_t i = 0; i < n; i += V::width) store<V>(y + i, load<V>(x + i, n - i) * s, n - i);
  }

  /// Sum of (x - mean)^2, or of x if `mean` is null. Two accumulators, so that additions do not wait for each other.
  static VLA_INLINE float sum(const float* x, const float* mean, std::int64_t n) {
    const auto add = [&](Float& sum, Float value) VLA_LAMBDA {
      sum = mean == nullptr ? sum + value : V::fma(value - *mean, value - *mean, sum);
    };
    Float even = {}, odd = {};
    std::int64_t i = 0;
    for (; i + 2 * V::width <= n; i += 2 * V::width) {
      add(even, V::load(x + i));
      add(odd, V::load(x + i + V::width));
    }
    float total = V::sum(even + odd);
    for (; i < n; ++i) total += mean == nullptr ? x[i] : (x[i] - *mean) * (x[i] - *mean);
    return total;
  }

  /// y = (x - mean) * factor * weight + bias
  static VLA_INLINE void scale(const float* x, float mean, float factor, const float* weight, const float* bias,
                               float* y, std::int64_t n) {
    for (std::int64_t i = 0; i < n; i += V::width) {
      Float value = (load<V>(x + i, n - i) - mean) * factor;
      if (weight != nullptr) value *= load<V>(weight + i, n - i);
      if (bias != nullptr) value += load<V>(bias + i, n - i);
      store<V>(y + i, value, n - i);
    }
  }

  static void layer_norm(const float* x, const float* weight, const float* bias, float eps, float* y, std::int64_t n) {
    const float mean = sum(x, nullptr, n) / static_cast<float>(n);
    const float variance = sum(x, &mean, n) / static_cast<float>(n);
    scale(x, mean, 1.0f / __builtin_sqrtf(variance + eps), weight, bias, y, n);
  }

  static void rms_norm(const float* x, const float* weight, const float* bias, float eps, float* y, std::int64_t n) {
    const float zero = 0.0f, mean_square = sum(x, &zero, n) / static_cast<float>(n);
    scale(x, zero, 1.0f / __builtin_sqrtf(mean_square + eps), weight, bias, y, n);
  }

  static void rotate_half(const float* x, const float* w, const float*, float, float* y, std::int64_t n) {
    const std::int64_t half = n / 2;
    for (std::int64_t i = 0; i < half; i += V::width) {
      const std::int64_t left = half - i;
      const Float a = load<V>(x + i, left), b = load<V>(x + half + i, left);
      const Float c = load<V>(w + i, left), s = load<V>(w + half + i, left);
      store<V>(y + i, V::fma(a, c, -(b * s)), left);
      store<V>(y + half + i, V::fma(b, c, a * s), left);
    }
  }
};

}  // namespace vla::kernels
