// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/cpu_kernels.h"

#include "kernels/cpu_kernels_make.h"
#include "kernels/numbers.h"

namespace vla::kernels {

RowKernel CpuKernels::activation(Activation activation) const {
  switch (activation) {
    case Activation::gelu_tanh:
      return gelu_tanh;
    case Activation::gelu_erf:
      return gelu_erf;
    case Activation::silu:
      return silu;
    case Activation::relu:
      return relu;
    case Activation::relu_squared:
      return relu_squared;
    case Activation::none:
      break;
  }
  return nullptr;
}

#if defined(__x86_64__)
// Each in the file of its name.
extern const CpuKernels kAvx2Kernels, kAvx512Kernels;
extern const AttentionKernel kAttentionAvx512Bf16, kAttentionAmx;

namespace {

CpuKernels avx512_with(const AttentionKernel& attention) {
  CpuKernels kernels = kAvx512Kernels;
  kernels.attention = attention;
  return kernels;
}

}  // namespace

const CpuKernels* cpu_kernels(Features use) {
  static const CpuKernels avx512_bf16 = avx512_with(kAttentionAvx512Bf16), amx = avx512_with(kAttentionAmx);
  if (use.has(Feature::amx_bf16)) return &amx;
  if (use.has(Feature::avx512_bf16)) return &avx512_bf16;
  if (use.has(Feature::avx512)) return &kAvx512Kernels;
  return use.has(Feature::avx2) ? &kAvx2Kernels : nullptr;
}
#else
const CpuKernels* cpu_kernels(Features) { return nullptr; }
#endif

const CpuKernels& portable_kernels() {
  static constexpr CpuKernels kernels = CpuKernelsMaker<Portable, 6>::make();
  return kernels;
}

namespace {

/// A tile of attention_amx.cpp, number by number.
struct EmulatedTile {
  struct Session {};

  using Float = Portable::Float;

  static void store(std::uint16_t* to, Float a, Float b) {
    for (Float x : {a, b})
      for (int i = 0; i < Portable::width; ++i) *to++ = to_bf16(x[i]);
  }

  void open(const float* c, int stride, bool sum) {
    for (int r = 0; r < 32; ++r)
      for (int n = 0; n < 32; ++n) sums[r][n] = sum ? c[r * stride + n] : 0.0f;
  }
  void step(const std::uint16_t* a, int stride, const std::uint16_t* panel) {
    for (int r = 0; r < 32; ++r)
      for (int n = 0; n < 32; ++n)
        for (int k = 0; k < 32; ++k)
          sums[r][n] +=
              from_bf16(a[r * stride + k]) * from_bf16(panel[PairProducts<Portable, EmulatedTile>::place(k, n)]);
  }
  void close(float* c, int stride) const {
    for (int r = 0; r < 32; ++r) std::memcpy(c + r * stride, sums[r], sizeof(sums[r]));
  }

  float sums[32][32];
};

}  // namespace

const AttentionKernel& emulated_amx_attention() {
  using Attention = AttentionTile<PairProducts<Portable, EmulatedTile>>;
  static constexpr AttentionKernel kernel = Attention::kernel();
  return kernel;
}

}  // namespace vla::kernels
