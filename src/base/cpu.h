// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <compare>
#include <cstdint>
#include <initializer_list>

namespace vla {

/// A feature that some processors have and others lack.
enum class Feature {
  baseline,  // the baseline that the whole program is compiled for
  avx2,      // with FMA and F16C
  avx512,    // F, BW, DQ, VL
  avx512_bf16,
  avx512_vnni,
  avx_vnni,
  amx_bf16,  // with the operating system's permission to use tiles
  amx_int8,
  permutes_beside_vnni,  // a permutation and a VNNI product in the same cycle: AMD, not Intel
  neon,
  dotprod,    // SDOT
  neon_bf16,  // BFMMLA
  i8mm,       // SMMLA
};

/// A set of features: those that a processor has, or those that kernels may use.
class Features {
 public:
  constexpr Features() = default;
  constexpr Features(std::initializer_list<Feature> all) {
    for (const Feature one : all) bits_ |= bit(one);
  }

  constexpr bool has(Feature one) const { return (bits_ & bit(one)) != 0; }
  constexpr bool has_all(Features all) const { return (bits_ & all.bits_) == all.bits_; }
  constexpr bool empty() const { return bits_ == 0; }
  constexpr Features with(Feature one) const { return Features(bits_ | bit(one)); }
  constexpr Features both(Features other) const { return Features(bits_ & other.bits_); }
  constexpr Features without(Features other) const { return Features(bits_ & ~other.bits_); }
  constexpr auto operator<=>(const Features&) const = default;

 private:
  explicit constexpr Features(std::uint32_t bits) : bits_(bits) {}
  static constexpr std::uint32_t bit(Feature one) { return std::uint32_t{1} << static_cast<unsigned>(one); }

  std::uint32_t bits_ = 0;
};

/// Detects the features of this processor. It has a source file of its own so that a test program that emulates another
/// machine can link another definition.
Features detect_features();

/// The features of this processor, detected at the first call.
inline const Features& this_cpu() {
  static const Features features = detect_features();
  return features;
}

}  // namespace vla
