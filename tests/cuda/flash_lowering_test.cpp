// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Attention of many query rows by wgmma, through the fake driver (see lowering_test.cpp).
#include "cuda/fake_driver.h"
#include "lower/lower_case.h"

namespace flash_lowering_test {

using namespace vla;
using namespace vla::test;

namespace {

struct Attention {
  int d_head, n_head, n_head_kv, n_query, n_batch;
  std::vector<int> segments;
  bool has_mask = false;
};

/// The result, and the kernel that computed it.
std::pair<std::vector<float>, std::string> run(const Attention& of, const std::string& kernels) {
  const LowerParams params(DType::bf16);  // attention reads bf16 where matrices are bf16
  GraphRunner r(params.list(), kernels);
  const Tensor q = input(r, {of.d_head, of.n_head, of.n_query, of.n_batch});
  std::vector<KeyValue> segments;
  int n_key = 0;
  for (const int n : of.segments) {
    const Shape shape = {of.d_head, of.n_head_kv, n, of.n_batch};
    segments.push_back({input(r, shape), input(r, shape, 2)}), n_key += n;
  }
  const Tensor mask = of.has_mask ? causal_mask(r.graph, n_key - of.n_query, of.n_query) : Tensor();
  r.graph.name("result", attention(r.graph, q, segments, mask));
  const std::string text = r.lower().text();
  r.run();
  const std::size_t at = std::min(text.find("hopper_flash"), text.find("attention_bf16"));
  return {r.tap("result"), at == text.npos ? "" : text.substr(at, text.find_first_of(" \n", at) - at)};
}

}  // namespace

TEST_CASE("with VLA_CUDA_WITH=flash wgmma attends over one segment of keys, where that is estimated to be faster") {
  const struct {
    Attention of;
    const char* kernel;
  } cases[] = {{{64, 6, 2, 100, 1, {150}, true}, "hopper_flash_64x"},
               {{72, 2, 2, 130, 2, {130}}, "hopper_flash_80x"},
               {{256, 4, 1, 80, 1, {80}}, "hopper_flash_256x"},
               {{64, 2, 2, 100, 1, {70, 60}}, "attention_bf16_64"},      // segments
               {{72, 2, 2, 130, 1, {130}, true}, "hopper_flash_128x"}};  // with a mask in wider blocks
  for (const auto& [of, kernel] : cases) {
    const auto [expected, plain] = run(of, "ggml");
    const auto [without, other] = run(of, "");
    REQUIRE(setenv("VLA_CUDA_WITH", "flash", 1) == 0);
    const auto [found, taken] = run(of, "");
    REQUIRE(unsetenv("VLA_CUDA_WITH") == 0);
    INFO(taken, " in the place of ", other);
    CHECK(other.starts_with("attention_bf16"));
    CHECK(taken.starts_with(kernel));
    check_close(found, expected, 4e-3);
  }
}

}  // namespace flash_lowering_test
