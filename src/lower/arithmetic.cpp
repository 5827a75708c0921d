// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/arithmetic.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>

namespace vla {
namespace {

constexpr const char *kFloat32 = "float32", *kBf16 = "bf16", *kInt8 = "int8", *kInt4 = "int4";

/// Selects a kernel set, limited to the features that the machine has. Errors: device.
Result<Arithmetic> with(const KernelSet& set, Features machine) {
  if (machine.has_all(set.needs))
    return Arithmetic{set == kernel_set::ggml ? Arithmetic::Backend::ggml : Arithmetic::Backend::own,
                      machine.both(set.uses)};
  std::vector<std::string> names;
  for (const KernelSet& usable : kernel_sets(machine)) names.push_back(usable.name);
  return Error{Code::device, "kernels", fmt::format("what this machine can run: {}", fmt::join(names, ", ")), set.name,
               "leave the choice to the program"};
}

/// Returns the machine's best kernels, with large matrices converted to this dtype at load.
Arithmetic rounding(Rounding at_load, Arithmetic best) {
  best.at_load = at_load;
  return best;
}

}  // namespace

Result<Arithmetic> Arithmetic::on_cpu(const std::string& kernels, Features machine) {
  VLA_TRY(const Arithmetic best, with(kernel_set_of(machine), machine));
  if (kernels.empty()) return best;
  if (kernels == kFloat32) {
    VLA_TRY(const Arithmetic exact, with(kernel_set_of(without_rounding(machine)), machine));
    return rounding(Rounding::float32, exact);
  }
  if (kernels == kBf16 && !rounds_to_bf16(machine))
    return Error{Code::device, "kernels", "a machine with AVX-512 BF16, AMX or ARM's BF16", kernels,
                 "leave the choice to the program"};
  if (kernels == kBf16) return rounding(Rounding::bf16, best);
  if (kernels == kInt8) return rounding(Rounding::int8, best);
  if (kernels == kInt4) return rounding(Rounding::int4, best);
  for (const KernelSet& set : kernel_set::all)
    if (kernels == set.name) return with(set, machine);
  return Error{Code::usage, "kernels",
               "ggml, portable, neon, neon_bf16, avx2, avx512, avx512_bf16, amx, float32, bf16, int8 or int4", kernels};
}

Result<Arithmetic> Arithmetic::on_device(const std::string& kernels, const std::string& device) {
  const bool has_own = device.starts_with("cuda");
  const Backend best = has_own ? Backend::own : Backend::ggml;
  if (kernels == kernel_set::ggml.name) return Arithmetic{Backend::ggml, {}};
  if (kernels.empty()) return Arithmetic{best, {}};
  if (kernels == kFloat32) return Arithmetic{best, {}, has_own ? Rounding::float32 : Rounding::none};
  if (kernels == kBf16) return Arithmetic{best, {}, Rounding::bf16};
  if (kernels == kInt8 && has_own) return Arithmetic{best, {}, Rounding::int8};
  if (kernels == kInt4 && has_own) return Arithmetic{best, {}, Rounding::int4};
  return Error{Code::usage, "kernels",
               fmt::format("none, float32, bf16{} or ggml with device {}", has_own ? ", int8, int4" : "", device),
               kernels, "other kernels are the CPU's"};
}

Features features_for(const ParamList& list, Features use, Rounding rounding) {
  const auto rounds = [&](const Param& param) {
    const DType type = resident_encoding(param, rounding).type;
    return param.storage == Storage::matrix && (type == DType::bf16 || type == DType::i8 || type == DType::int4);
  };
  return std::ranges::any_of(list.params(), rounds) ? use : without_rounding(use);
}

std::int64_t min_rounded_keys(const ParamList& list) {
  const auto is_ternary = [](const Param& param) { return param.encoding.type == DType::ternary; };
  return std::ranges::any_of(list.params(), is_ternary) ? 512 : 128;
}

}  // namespace vla
