// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Whole policies on our own kernels for CUDA through the fake driver. `open_device` of this program hands out that
// device in the place of the CPU's kernels in float32.
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <functional>

#include "cuda/fake_driver.h"
#include "cuda/machine.h"
#include "devices/devices.h"
#include "lower/cuda/cuda_device.h"
#include "lower/lower_case.h"
#include "support/editable_bundle.h"
#include "support/golden_case.h"

using namespace vla;
using namespace vla::test;

namespace vla {

// Of the linker: `--wrap` gives these names to what calls open_device(), and to that itself.
Result<std::unique_ptr<Device>> real_open_device(int, const std::string&, const std::string&) asm(
    "__real__ZN3vla11open_deviceEiRKNSt7__cxx1112basic_stringIcSt11char_traitsIcESaIcEEES7_");
Result<std::unique_ptr<Device>> wrapped_open_device(int, const std::string&, const std::string&) asm(
    "__wrap__ZN3vla11open_deviceEiRKNSt7__cxx1112basic_stringIcSt11char_traitsIcESaIcEEES7_");

Result<std::unique_ptr<Device>> wrapped_open_device(int n_thread, const std::string& kernels,
                                                    const std::string& device) {
  if (kernels.starts_with("model:")) return lower::CudaDevice::model(kernels.substr(6), Rounding::float32);
  if (kernels == "ggml") return real_open_device(n_thread, kernels, device);
  const Rounding at_load = kernels == "bf16"   ? Rounding::bf16
                           : kernels == "int8" ? Rounding::int8
                           : kernels.empty()   ? Rounding::none
                                               : Rounding::float32;
  return lower::CudaDevice::open(test::cuda::fake_driver_table(), 0, test::cuda::modules_of_tests(), at_load);
}

}  // namespace vla

namespace {

/// Golden cases whose path has VLA_FAMILY in it, or with VLA_ALL_FAMILIES all, or small ones of three families.
std::vector<std::string> cases() {
  const bool all = std::getenv("VLA_ALL_FAMILIES") != nullptr;
  const char* family = std::getenv("VLA_FAMILY");
  std::vector<std::string> paths = golden_paths();
  std::erase_if(paths, [&](const std::string& path) {
    if (family != nullptr) return path.find(family) == path.npos;
    const auto has = [&](const char* part) { return path.find(part) != path.npos; };
    return !all && !has("/smolvla/sparse_expert") && !has("/smolvla/absent_view") && !has("/bitvla/two_layers") &&
           !has("/act/two_views");
  });
  return paths;
}

ActionChunk act(Engine& engine, const GoldenCase& golden) {
  auto chunk = engine.act(golden.observation, golden.noise);
  REQUIRE_MESSAGE(chunk.ok(), (chunk ? "" : chunk.error().message() + test::cuda::fake_driver().fault));
  return std::move(*chunk);
}

double norm_of_difference(const std::vector<float>& a, const std::vector<float>& b, bool largest) {
  double most = 0, squares = 0;
  REQUIRE(a.size() == b.size());
  for (std::size_t i = 0; i < a.size(); ++i) {
    const double difference = std::abs(double{a[i]} - double{b[i]});
    most = std::max(most, difference), squares += difference * difference;
  }
  return largest ? most : std::sqrt(squares / static_cast<double>(a.size()));
}

/// Acts with products of bf16. The chunk is nearer to the float32 reference than PyTorch's in bf16, by both norms.
/// Tensor cores are emulated with sums in float32, one product after the other.
void check_nearer_than_bf16(const std::string& path) {
  CAPTURE(path);
  const GoldenCase golden = GoldenCase::read(path);
  const auto engine = load_engine(golden.bundle(), "chunk");
  const ActionChunk chunk = act(*engine, golden);
  const auto expected = golden.expected();
  const auto &reference = find_tap(expected, "chunk").values, &bf16 = find_tap(expected, "chunk.bf16").values;
  const auto& ours = find_tap(chunk.taps, "chunk").values;
  MESSAGE(path, ": ", engine->device().linear_kernels());
  for (const bool largest : {false, true}) {
    MESSAGE(norm_of_difference(ours, reference, largest), " of ", norm_of_difference(bf16, reference, largest));
    CHECK(norm_of_difference(ours, reference, largest) <= norm_of_difference(bf16, reference, largest));
  }
}

bool attended_in_cluster() {
  return std::ranges::any_of(test::cuda::fake_driver().in_clusters,
                             [](const std::string& kernel) { return kernel.starts_with("hopper_attention"); });
}

}  // namespace

TEST_CASE("policies on our own kernels for CUDA match the reference at every tap within 1e-4") {
  for (const std::string& path : cases()) {
    CAPTURE(path);
    test::cuda::reset_fake_driver();
    const GoldenCase golden = GoldenCase::read(path);
    const auto engine = load_engine(golden.bundle(), "*", "float32");
    const ActionChunk chunk = act(*engine, golden);
    for (const Tap& expected : golden.expected()) {
      if (expected.path == "chunk.bf16" || expected.path.starts_with("position_ids")) continue;
      const auto difference = compare_taps({expected}, {find_tap(chunk.taps, expected.path)}).front();
      CAPTURE(expected.path);
      CAPTURE(difference.relative);
      CHECK(difference.within(1e-4));
    }
  }
}

TEST_CASE("products of bf16 give a chunk nearer to the float32 reference than PyTorch's bf16, by both norms") {
  for (const std::string& path : cases()) {
    test::cuda::reset_fake_driver();
    check_nearer_than_bf16(path);
  }
}

TEST_CASE("so they do where attention takes clusters, as it does on as many SMs as an H200 has") {
  const auto has_many_keys = [](const std::string& path) { return path.ends_with("/vla_adapter/spatial"); };
  std::vector<std::string> paths = cases();
  std::erase_if(paths, std::not_fn(has_many_keys));
  if (paths.empty()) MESSAGE("skipped: VLA_ALL_FAMILIES has the case");
  for (const std::string& path : paths) {
    test::cuda::reset_fake_driver();
    test::cuda::fake_driver().n_sm = 132;
    check_nearer_than_bf16(path);
    CHECK(attended_in_cluster());
  }
  test::cuda::reset_fake_driver();
}

TEST_CASE("so they do where wgmma attends in prefixes, with VLA_CUDA_WITH=flash") {
  const char* const which = std::getenv("VLA_ALL_FAMILIES") != nullptr ? "/one_view" : "/smolvla/one_view";
  std::vector<std::string> paths = golden_paths();
  std::erase_if(paths, [&](const std::string& path) { return !path.ends_with(which); });
  REQUIRE(setenv("VLA_CUDA_WITH", "flash", 1) == 0);
  for (const std::string& path : paths) {
    test::cuda::reset_fake_driver();
    check_nearer_than_bf16(path);
    CHECK(std::ranges::any_of(test::cuda::fake_driver().launched,
                              [](const std::string& kernel) { return kernel.starts_with("hopper_flash"); }));
  }
  REQUIRE(unsetenv("VLA_CUDA_WITH") == 0);
  test::cuda::reset_fake_driver();
}

TEST_CASE("attention of few queries fills a device, and of many takes the keys one tile after the other") {
  const auto blocks = [](std::int64_t d_head, std::int64_t n_row, std::int64_t n_unit, std::int64_t n_key, int n_sm) {
    const lower::AttentionPlan plan = lower::plan_attention(d_head, n_row, n_unit, n_key, n_sm, false);
    CHECK(plan.shape->depth >= d_head);
    CHECK(plan.n_split <= vla::cuda::kMaxAttentionSplit);
    return (n_row + plan.shape->rows - 1) / plan.shape->rows * n_unit * plan.n_split;
  };
  CHECK(blocks(72, 16, 1, 1 << 16, 132) >= 8);
}

TEST_CASE("a cluster combines the shares of attention on Hopper alone, and where that is estimated to be faster") {
  int n_cluster = 0;
  for (const std::int64_t d_head : {64, 128, 256})
    for (const std::int64_t n_row : {16, 400, 4000})
      for (const std::int64_t n_key : {60, 300, 1200, 5000}) {
        const lower::AttentionPlan elsewhere = lower::plan_attention(d_head, n_row, 1, n_key, 132, false),
                                   hopper = lower::plan_attention(d_head, n_row, 1, n_key, 132, true);
        INFO(n_row, " rows, heads of ", d_head, ", ", n_key, " keys: ", hopper.shape->kernel, ", ", hopper.n_split);
        CHECK(!elsewhere.in_cluster);
        CHECK(hopper.in_cluster == (hopper.us < elsewhere.us));
        CHECK((!hopper.in_cluster || hopper.shape->fits_cluster(hopper.n_split)));
        n_cluster += hopper.in_cluster ? 1 : 0;
      }
  CHECK(n_cluster > 0);
  CHECK(n_cluster < 36);
}

TEST_CASE("a graph's attention in a cluster is a launch less, and as near to the reference") {
  const LowerParams params(DType::bf16);  // attention reads bf16 where matrices are bf16
  const auto attend = [](GraphRunner& r, const LowerParams&) {
    const Tensor k = input(r, {256, 1, 300, 1}), v = input(r, {256, 1, 300, 1}, 2);
    return attention(r.graph, input(r, {256, 8, 5, 1}), {{k, v}}, {});
  };
  const std::vector<float> expected = result_of("ggml", params, attend);
  long n_launch[2] = {};
  for (const int major : {9, 8}) {
    if (major == 8 && test::cuda::runs_ptx()) continue;  // of Hopper alone
    test::cuda::reset_fake_driver();
    test::cuda::fake_driver().major = major, test::cuda::fake_driver().n_sm = 132;
    check_close(result_of("", params, attend), expected, 4e-3);
    CHECK(attended_in_cluster() == (major == 9));
    n_launch[9 - major] = test::cuda::fake_driver().n_call["cuLaunchKernelEx"];
  }
  if (!test::cuda::runs_ptx()) CHECK(n_launch[0] == n_launch[1] - 1);
  test::cuda::reset_fake_driver();
}

TEST_CASE("attention takes the shape and the shares that were fastest on an H200, or within a tenth of it") {
  struct Size {
    std::int64_t d_head, n_row, n_unit, n_key;
    std::vector<std::pair<std::string, int>> fast;
  };
  const Size sizes[] = {
      {48, 41, 32, 41, {{"attention_bf16_64_16", 1}, {"attention_bf16_64", 1}}},          // GR00T N1.7, self
      {48, 41, 32, 200, {{"attention_bf16_64_16", 1}}},                                   // GR00T N1.7, cross
      {128, 388, 8, 194, {{"attention_bf16_128_32", 1}, {"attention_bf16_128_16", 1}}},   // GR00T N1.7, language
      {64, 256, 32, 256, {{"attention_bf16_64", 1}, {"attention_bf16_64_32", 1}}},        // GR00T N1.7, vision
      {256, 400, 1, 610, {{"attention_bf16_256_32", 5}, {"attention_bf16_256_32", 10}}},  // pi0.5, step
      {256, 4480, 1, 560, {{"attention_bf16_256_32", 1}, {"attention_bf16_256", 1}}},     // pi0.5, prefix
      {72, 256, 32, 256, {{"attention_bf16_80", 1}}},                                     // pi0.5 and BitVLA, vision
      {64, 150, 5, 227, {{"attention_bf16_64_16", 1}}},                                   // SmolVLA, step
      {64, 531, 5, 177, {{"attention_bf16_64_32", 1}, {"attention_bf16_64_16", 1}}},      // SmolVLA, prefix
      {64, 1024, 24, 1024, {{"attention_bf16_64", 1}}},                                   // SmolVLA, vision
      {128, 2568, 5, 642, {{"attention_bf16_128", 1}}},                                   // BitVLA, language
  };
  for (const Size& size : sizes) {
    const lower::AttentionPlan plan =
        lower::plan_attention(size.d_head, size.n_row, size.n_unit, size.n_key, 132, false);
    INFO(size.d_head, " of a head, ", size.n_key, " keys: ", plan.shape->kernel, ", shares ", plan.n_split);
    CHECK(std::find(size.fast.begin(), size.fast.end(),
                    std::pair<std::string, int>(plan.shape->kernel, plan.n_split)) != size.fast.end());
  }
}
