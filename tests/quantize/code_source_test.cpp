// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Codes that come from elsewhere than from the matrix alone.
#include <doctest/doctest.h>

#include "quantize/hessian.h"
#include "quantize/quantize.h"
#include "support/editable_bundle.h"

namespace code_source_test {

using namespace vla;
using namespace vla::test;

namespace {

/// The shipped policy has matrices that are large enough for codes.
const std::string kPolicy = VLA_SOURCE_DIR "/models/metaworld-tiny.gguf";

Bundle quantized(const char* to, const Choice& choice, const CodeSource& source) {
  const std::string path = write_file(to, "");
  REQUIRE(quantize(
              kPolicy, path, choice, "", [](QuantizeProgress) {}, source)
              .ok());
  Result<Bundle> bundle = Bundle::open(path);
  REQUIRE(bundle.ok());
  return std::move(*bundle);
}

std::vector<std::byte> bytes_of(const Bundle& bundle, const std::string& tensor) {
  ReadBuffer buffer;
  const auto read = bundle.read(bundle.find(tensor)->data, buffer);
  REQUIRE(read.ok());
  return {read->begin(), read->end()};
}

}  // namespace

TEST_CASE("codes of bundles that have them are copied, each of the kind that is wanted") {
  std::vector<float> feedback;
  const CodeSource compensated = {[&](const Bundle&, const TensorInfo& tensor) -> Result<std::span<const float>> {
    feedback.assign(Hessian::size(tensor.shape[0]) / sizeof(float), 0.01f);
    return std::span<const float>(feedback);
  }};
  const Bundle int8 = quantized("int8.gguf", all_as(Rounding::int8), compensated);
  const Bundle int4 = quantized("int4.gguf", all_as(Rounding::int4), compensated);
  const Choice mixed = [](const std::string& tensor) {
    return tensor.starts_with("lm.") ? Rounding::int8 : Rounding::int4;
  };
  const Bundle plain = quantized("plain.gguf", mixed, {});
  const Bundle both = quantized("both.gguf", mixed, {.feedback = {}, .made = {&int8, &int4}});
  int n_int8 = 0, n_int4 = 0;
  for (const TensorInfo& tensor : both.tensors()) {
    if (tensor.type != DType::i8) continue;
    CAPTURE(tensor.name);
    const bool is_int8 = tensor.name.starts_with("lm.");
    ++(is_int8 ? n_int8 : n_int4);
    const Bundle& made = is_int8 ? int8 : int4;
    for (const std::string& name : {tensor.name, tensor.name + "_scale"})
      CHECK(bytes_of(both, name) == bytes_of(made, name));
    CHECK(bytes_of(both, tensor.name) != bytes_of(plain, tensor.name));
  }
  CHECK(n_int8 > 10);
  CHECK(n_int4 > 10);
}

}  // namespace code_source_test
