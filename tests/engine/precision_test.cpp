// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Which arithmetic a bundle gets: bf16 only where all its matrices are stored so and the machine has tiles for it.
#include <doctest/doctest.h>

#include <algorithm>

#include "lower/precision.h"
#include "policies/policy.h"
#include "support/editable_bundle.h"
#include "support/golden_case.h"

using namespace vla;
using namespace vla::test;

namespace {

const std::string kBundle = golden_path("smolvla/two_views/bundle.gguf");

/// The kernels for a bundle on a machine for `isa`.
Isa isa_of(const std::string& path, Isa isa) {
  const auto bundle = Bundle::open(path);
  REQUIRE(bundle.ok());
  ParamList list(bundle->keys(), &*bundle);
  const auto policy = find_policy("smolvla")->make(list);
  return isa_for(list, isa);
}

/// The golden bundle, whose matrices are bf16, with the same numbers of one tensor in float32.
std::string widened(const std::string& tensor) {
  EditableBundle bundle = EditableBundle::read(kBundle);
  EditableBundle::Piece& piece = bundle.tensor(tensor);
  REQUIRE(piece.type == DType::bf16);
  std::string wide;
  for (std::size_t i = 0; i < piece.data.size(); i += 2) wide += std::string(2, '\0') + piece.data.substr(i, 2);
  piece.type = DType::f32, piece.data = wide;
  return bundle.write("widened.gguf");
}

}  // namespace

TEST_CASE("a bundle of bf16 matrices is computed in bf16 where the machine has instructions for it") {
  CHECK(isa_of(kBundle, Isa::amx) == Isa::amx);
  for (Isa isa : {Isa::avx512_bf16, Isa::avx512, Isa::avx2, Isa::ggml}) CHECK(isa_of(kBundle, isa) == isa);
}

TEST_CASE("one matrix of another dtype makes the whole policy float32, and a table does not") {
  CHECK(isa_of(widened("lm.blk.0.attn_q.weight"), Isa::amx) == Isa::avx512);
  CHECK(isa_of(widened("lm.blk.0.attn_q.weight"), Isa::avx512_bf16) == Isa::avx512);
  CHECK(isa_of(widened("lm.token_embd.weight"), Isa::amx) == Isa::amx);
}

TEST_CASE("attention between ternary products rounds from more keys on; their sums are the same on all machines") {
  const auto bundle = Bundle::open(golden_path("bitvla/micro/bundle.gguf"));
  REQUIRE(bundle.ok());
  ParamList list(bundle->keys(), &*bundle);
  const auto policy = find_policy("bitvla")->make(list);
  for (Isa isa : {Isa::amx, Isa::avx512_bf16}) CHECK(isa_for(list, isa) == isa);
  CHECK(min_rounded_keys(list) == 512);
  const Keys none;
  CHECK(min_rounded_keys(ParamList(none, nullptr)) == 128);
}

TEST_CASE("an engine tells the kernels and the precision of its bundle, not those of the machine") {
  CHECK(load_engine(kBundle)->precision() == (rounds_to_bf16(usable_isas().back()) ? "bf16" : "f32"));
  CHECK(load_engine(kBundle, "", "float32")->precision() == "f32");
  const auto engine = load_engine(widened("lm.blk.0.attn_q.weight"));
  CHECK(engine->precision() == "f32");
  CHECK(engine->arithmetic() == "float32");
  CHECK(engine->kernels() == isa_name(*choose_isa("float32")));
  CHECK(engine->arithmetic().find("int8") == std::string::npos);
}

TEST_CASE("an engine tells that matrices were quantized, as somebody asked" *
          doctest::skip(usable_isas().back() == Isa::ggml)) {
  const auto engine = load_engine(VLA_SOURCE_DIR "/models/metaworld-tiny.gguf", "", kInt8Kernels);
  CHECK(engine->precision() == "int8");
  CHECK(engine->arithmetic().find("as asked") != std::string::npos);
  CHECK(!engine->has_ternary());
}
