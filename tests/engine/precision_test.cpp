// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Which arithmetic a bundle gets: bf16 for the matrices that are stored so, where the machine has instructions for it.
#include <doctest/doctest.h>

#include <algorithm>

#include "lower/arithmetic.h"
#include "policies/policy.h"
#include "support/editable_bundle.h"
#include "support/golden_case.h"

namespace precision_test {

using namespace vla;
using namespace vla::test;

namespace {

const std::string kBundle = golden_path("smolvla/two_views/bundle.gguf");
/// The shipped policy has matrices that are worth rounding.
const std::string kShipped = VLA_SOURCE_DIR "/models/metaworld-tiny.gguf";

/// The kernels for a bundle on a machine that has all that a set uses.
KernelSet set_of(const std::string& path, const KernelSet& set) {
  const auto bundle = Bundle::open(path);
  REQUIRE(bundle.ok());
  ParamList list(bundle->keys(), &*bundle);
  const auto policy = find_policy("smolvla")->make(list);
  return kernel_set_of(features_for(list, set.uses));
}

/// A bundle whose matrices are bf16, with the same numbers of one tensor, or of all, in float32.
std::string widened(const std::string& name, const std::string& path = kBundle) {
  EditableBundle bundle = EditableBundle::read(path);
  int n = 0;
  for (EditableBundle::Piece& piece : bundle.tensors) {
    if (piece.type != DType::bf16 || (name != "all" && piece.name != name)) continue;
    std::string wide;
    for (std::size_t i = 0; i < piece.data.size(); i += 2) wide += std::string(2, '\0') + piece.data.substr(i, 2);
    piece.type = DType::f32, piece.data = wide, ++n;
  }
  REQUIRE(n > 0);
  return bundle.write("widened.gguf");
}

}  // namespace

TEST_CASE("a bundle of bf16 matrices is computed in bf16 where the machine has instructions for it") {
  CHECK(set_of(kBundle, kernel_set::amx) == kernel_set::amx);
  for (const KernelSet& set : {kernel_set::avx512_bf16, kernel_set::avx512, kernel_set::avx2, kernel_set::neon_bf16,
                               kernel_set::neon, kernel_set::ggml})
    CHECK(set_of(kBundle, set) == set);
}

TEST_CASE("a bundle without matrices of bf16 is computed in float32, whatever its tables are") {
  for (const KernelSet& set : {kernel_set::amx, kernel_set::avx512_bf16, kernel_set::neon_bf16}) {
    CHECK(set_of(widened("all"), set) == (set == kernel_set::neon_bf16 ? kernel_set::neon : kernel_set::avx512));
    CHECK(set_of(widened("lm.blk.0.attn_q.weight"), set) == set);
    CHECK(set_of(widened("lm.token_embd.weight"), set) == set);
  }
}

TEST_CASE("attention between ternary products rounds from more keys on; their sums are the same on all machines") {
  const auto bundle = Bundle::open(golden_path("bitvla/micro/bundle.gguf"));
  REQUIRE(bundle.ok());
  ParamList list(bundle->keys(), &*bundle);
  const auto policy = find_policy("bitvla")->make(list);
  for (const KernelSet& set : {kernel_set::amx, kernel_set::avx512_bf16})
    CHECK(kernel_set_of(features_for(list, set.uses)) == set);
  CHECK(min_rounded_keys(list) == 512);
  const Keys none;
  CHECK(min_rounded_keys(ParamList(none, nullptr)) == 128);
}

TEST_CASE("an engine tells the kernels and the precision of its bundle, not those of the machine") {
  CHECK(load_engine(kBundle)->precision() == (rounds_to_bf16(this_cpu()) ? Precision::bf16 : Precision::f32));
  CHECK(load_engine(kBundle, "", "float32")->precision() == Precision::f32);
  CHECK(load_engine(kBundle, "", "float32")->arithmetic() == "float32");
  CHECK(load_engine(kBundle)->arithmetic().find("int8") == std::string::npos);
}

TEST_CASE(
    "bf16 that is asked for by name rounds large matrices, tells it, and is refused where there is nothing to round" *
    doctest::skip(!rounds_to_bf16(usable_kernels().back()))) {
  EngineOptions options;
  options.kernels = "bf16";
  const auto refused = Engine::load(widened("all"), options);
  REQUIRE(!refused.ok());
  CHECK(refused.error().code == Code::unsupported);
  CHECK(refused.error().message().find("kernels bf16: expected matrices of bf16") != std::string::npos);
  CHECK(load_engine(kBundle, "", "bf16")->arithmetic() == load_engine(kBundle)->arithmetic());
  const auto rounded = load_engine(widened("all", kShipped), "", "bf16");
  CHECK(rounded->precision() == Precision::bf16);
  CHECK(rounded->arithmetic().find("63 matrices rounded to it, as asked for") != std::string::npos);
  CHECK(load_engine(widened("all", kShipped))->arithmetic() ==
        "float32; --kernels bf16 is faster and rounds 63 matrices");
  CHECK(load_engine(widened("all", kShipped), "", "float32")->arithmetic() == "float32");
}

TEST_CASE("a matrix of another dtype is multiplied in float32, and the others in bf16 as before" *
          doctest::skip(!rounds_to_bf16(usable_kernels().back()))) {
  const auto engine = load_engine(widened("lm.blk.0.attn_q.weight")), all = load_engine(kBundle);
  CHECK(engine->precision() == Precision::bf16);
  CHECK(engine->kernels() == all->kernels());
  CHECK(engine->linear_kernels().find("avx512 (1 f32)") != std::string::npos);
  CHECK(engine->linear_kernels().find(all->kernels() + " (") != std::string::npos);
}

TEST_CASE("an engine tells that matrices were quantized, as somebody asked") {
  const auto engine = load_engine(kShipped, "", "int8");
  CHECK(engine->precision() == Precision::int8);
  CHECK(engine->arithmetic().find("as asked") != std::string::npos);
  CHECK(!engine->has_ternary());
}

}  // namespace precision_test
