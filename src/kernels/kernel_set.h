// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "base/cpu.h"

namespace vla {

/// A set of kernels by its `--kernels` name: the features that it needs, and all features that it uses if present.
struct KernelSet {
  const char* name;
  Features needs, uses;

  bool operator==(const KernelSet& other) const { return needs == other.needs; }
};

namespace kernel_set {

inline constexpr KernelSet ggml = {"ggml", {}, {}};  // no kernels of our own: the reference for all others
inline constexpr KernelSet portable = {"portable", {Feature::baseline}, {Feature::baseline}};
inline constexpr KernelSet neon = {"neon", {Feature::neon}, {Feature::neon, Feature::dotprod, Feature::i8mm}};
inline constexpr KernelSet neon_bf16 = {
    "neon_bf16", {Feature::neon, Feature::neon_bf16}, neon.uses.with(Feature::neon_bf16)};
inline constexpr KernelSet avx2 = {"avx2", {Feature::avx2}, {Feature::avx2, Feature::avx_vnni}};
inline constexpr KernelSet avx512 = {
    "avx512",
    {Feature::avx2, Feature::avx512},
    {Feature::avx2, Feature::avx_vnni, Feature::avx512, Feature::avx512_vnni, Feature::permutes_beside_vnni}};
inline constexpr KernelSet avx512_bf16 = {
    "avx512_bf16", {Feature::avx2, Feature::avx512, Feature::avx512_bf16}, avx512.uses.with(Feature::avx512_bf16)};
inline constexpr KernelSet amx = {"amx",
                                  {Feature::avx2, Feature::avx512, Feature::avx512_bf16, Feature::amx_bf16},
                                  avx512_bf16.uses.with(Feature::amx_bf16).with(Feature::amx_int8)};

/// The best last.
inline constexpr KernelSet all[] = {ggml, portable, neon, neon_bf16, avx2, avx512, avx512_bf16, amx};

}  // namespace kernel_set

/// The sets that a processor can run, `ggml` first and the best last.
std::vector<KernelSet> kernel_sets(Features machine);
/// The sets that this processor can run.
const std::vector<KernelSet>& usable_kernels();

/// The best set that needs only these features.
const KernelSet& kernel_set_of(Features use);
inline std::string name_of(const KernelSet& set) { return set.name; }
inline std::string name_of(Features use) { return kernel_set_of(use).name; }

/// Whether kernels that use these features round operands to bf16.
constexpr bool rounds_to_bf16(Features use) { return use.has(Feature::avx512_bf16) || use.has(Feature::neon_bf16); }
constexpr bool rounds_to_bf16(const KernelSet& set) { return rounds_to_bf16(set.uses); }

/// These features without those that round to bf16.
constexpr Features without_rounding(Features use) {
  return use.without({Feature::avx512_bf16, Feature::amx_bf16, Feature::amx_int8, Feature::neon_bf16});
}

}  // namespace vla
