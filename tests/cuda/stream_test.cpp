// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Whole policies within a budget of device memory: matrices that come through windows while others are multiplied.
#include <doctest/doctest.h>

#include <unistd.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <map>
#include <set>

#include "cuda/fake_driver.h"
#include "cuda/machine.h"
#include "lower/chain.h"
#include "lower/cuda/cuda_device.h"
#include "support/golden_case.h"

namespace stream_test {

using namespace vla;
using namespace vla::test;
using test::cuda::fake_driver;

namespace {

constexpr std::size_t kAll = std::size_t{1} << 40;

/// As it was, for tests of other files.
struct Driver {
  ~Driver() { test::cuda::reset_fake_driver(); }
};

std::unique_ptr<Engine> load(const std::string& bundle, const std::string& kernels, std::size_t memory) {
  auto engine = Engine::load(bundle, {.kernels = kernels, .memory = memory});
  REQUIRE_MESSAGE(engine.ok(), (engine ? "" : engine.error().message()));
  return std::move(*engine);
}

/// The least budget that would do.
std::size_t least(const std::string& bundle, const std::string& kernels) {
  const auto engine = Engine::load(bundle, {.kernels = kernels, .dry = true, .memory = kAll});
  REQUIRE_MESSAGE(engine.ok(), (engine ? "" : engine.error().message()));
  CHECK((*engine)->budget().n_read == 0);
  return (*engine)->budget().smallest;
}

std::vector<float> actions(Engine& engine, const GoldenCase& golden) {
  const auto chunk = engine.act(golden.observation, golden.noise);
  REQUIRE_MESSAGE(chunk.ok(), (chunk ? "" : chunk.error().message() + fake_driver().fault));
  return chunk->actions;
}

/// Small policies that stream, and what multiplies; with VLA_ALL_FAMILIES one of each family that does.
std::vector<std::pair<std::string, std::string>> cases() {
  std::vector<std::string> wanted = {"/smolvla/sparse_expert", "/turbovla/no_state"};
  if (std::getenv("VLA_ALL_FAMILIES") != nullptr)
    for (const char* more : {"/act/old_layout", "/evo1/long_text", "/gr00t_n1_5/faint", "/gr00t_n1_6/faint",
                             "/gr00t_n1_7/faint", "/pi0/two_views", "/pi05/two_views", "/vla_jepa/camera"})
      wanted.emplace_back(more);
  std::vector<std::pair<std::string, std::string>> all;
  for (const std::string& path : golden_paths())
    for (const std::string& name : wanted)
      if (path.ends_with(name))
        for (const char* kernels : {"float32", ""}) all.emplace_back(path, kernels);
  return all;
}
GoldenCase small_case() { return GoldenCase::read(cases().front().first); }

/// A copy of a bundle that may be written to.
class Copy {
 public:
  explicit Copy(const std::string& bundle) {
    std::ifstream file(bundle, std::ios::binary);
    bytes_ = {std::istreambuf_iterator<char>(file), {}};
    std::ofstream(path_, std::ios::binary) << bytes_;
  }
  ~Copy() { std::filesystem::remove(path_); }

  const std::string& path() const { return path_; }
  /// All bytes behind the first half become others.
  void damage() const {
    std::string other = bytes_;
    for (std::size_t i = other.size() / 2; i < other.size(); ++i) other[i] = static_cast<char>(other[i] ^ 0x55);
    write(other);
  }
  void repair() const { write(bytes_); }

 private:
  void write(const std::string& bytes) const {
    std::fstream(path_, std::ios::binary | std::ios::in | std::ios::out) << bytes;
  }

  const std::string path_ =
      (std::filesystem::temp_directory_path() / ("cuda-stream-" + std::to_string(::getpid()) + ".gguf")).string();
  std::string bytes_;
};

}  // namespace

TEST_CASE_FIXTURE(Driver, "matrices of every layout that are streamed give the bits of resident ones") {
  constexpr int kDepth = 160;  // large enough to be rounded
  const std::pair<DType, Rounding> layouts[] = {{DType::f32, Rounding::none},    {DType::f16, Rounding::none},
                                                {DType::bf16, Rounding::none},   {DType::bf16, Rounding::float32},
                                                {DType::f32, Rounding::int8},    {DType::f32, Rounding::int4},
                                                {DType::ternary, Rounding::none}};
  for (const auto& [type, rounding] : layouts) {
    CAPTURE(dtype_name(type));
    CAPTURE(static_cast<int>(rounding));
    test::cuda::reset_fake_driver();
    const Chain chain(type, kDepth);
    const auto open = [rounding = rounding] {
      return std::move(
          *lower::CudaDevice::open(test::cuda::fake_driver_table(), 0, test::cuda::modules_of_tests(), rounding));
    };
    ChainAnswers resident(chain, open(), false), streamed(chain, open(), true);
    for (int seed = 0; seed < 4; ++seed) CHECK(streamed.run(seed) == resident.run(seed));
  }
}

TEST_CASE_FIXTURE(Driver,
                  "within the least budget of device memory a policy answers the bytes that it answers without one") {
  for (const auto& [path, kernels] : cases()) {
    CAPTURE(path);
    CAPTURE(kernels);
    test::cuda::reset_fake_driver();
    const GoldenCase golden = GoldenCase::read(path);
    const std::size_t smallest = least(golden.bundle(), kernels);
    const std::vector<float> expected = actions(*load(golden.bundle(), kernels, 0), golden);
    const auto engine = load(golden.bundle(), kernels, smallest);
    CHECK(engine->budget().n_read > 0);
    CHECK(fake_driver().used <= smallest);
    for (int i = 0; i < 2; ++i) CHECK(actions(*engine, golden) == expected);
  }
}

TEST_CASE_FIXTURE(Driver, "an act uploads each group once, launches what lies between, and takes no memory") {
  test::cuda::reset_fake_driver();
  fake_driver().computes = false;
  const GoldenCase golden = small_case();
  const auto engine = load(golden.bundle(), "float32", least(golden.bundle(), "float32"));
  std::map<std::string, long> calls;
  for (int i = 0; i < 3; ++i) {
    const std::map<std::string, long> before = fake_driver().n_call;
    actions(*engine, golden);
    calls.clear();
    for (const auto& [symbol, n] : fake_driver().n_call) {
      const auto found = before.find(symbol);
      if (n > (found != before.end() ? found->second : 0))
        calls[symbol] = n - (found != before.end() ? found->second : 0);
    }
  }
  const long n_group = calls["cuMemcpyHtoDAsync_v2"] - 1;  // beside the inputs
  CHECK(n_group > 3);
  CHECK(calls["cuStreamSynchronize"] == n_group + 1);
  CHECK(calls["cuStreamWaitEvent"] == n_group);
  CHECK(calls["cuGraphLaunch"] > 3);
  CHECK(calls["cuGraphLaunch"] <= 2 * n_group + 1);
  CHECK(calls["cuMemcpyDtoHAsync_v2"] == 1);
  for (const auto& [symbol, n] : calls)
    for (const char* word : {"Alloc", "Create", "Capture", "Instantiate", "Launch_"})
      CHECK_MESSAGE(symbol.find(word) == symbol.npos, symbol, ", ", n);
}

TEST_CASE_FIXTURE(Driver, "a budget that is too small is refused with the least that would do") {
  test::cuda::reset_fake_driver();
  const GoldenCase golden = small_case();
  const std::size_t smallest = least(golden.bundle(), "float32");
  const auto engine = Engine::load(golden.bundle(), {.kernels = "float32", .memory = smallest - 1});
  REQUIRE(!engine.ok());
  CHECK(engine.error().code == Code::out_of_memory);
  CHECK(engine.error().expected == std::to_string((smallest + 999999) / 1000000) + " MB or more");
  CHECK(fake_driver().used == 0);
  CHECK(fake_driver().n_handle == 0);
}

TEST_CASE_FIXTURE(
    Driver, "a file that changes while it is read is refused, and the policy acts again where its bytes are back") {
  test::cuda::reset_fake_driver();
  const GoldenCase golden = small_case();
  const Copy copy(golden.bundle());
  const auto engine = load(copy.path(), "float32", least(copy.path(), "float32"));
  const std::vector<float> expected = actions(*engine, golden);
  copy.damage();
  Status status;
  for (int i = 0; i < 3; ++i)
    if (const auto chunk = engine->act(golden.observation, golden.noise); !chunk) status = chunk.error();
  REQUIRE(!status.ok());
  CHECK(status.error().code == Code::bad_bundle);
  CHECK(engine->device().failure().ok());
  copy.repair();
  for (int i = 0; i < 3; ++i) CHECK(actions(*engine, golden) == expected);
}

TEST_CASE_FIXTURE(Driver,
                  "any call of the driver that fails while matrices stream is a typed error, and all is given back") {
  const GoldenCase golden = small_case();
  test::cuda::reset_fake_driver();
  const std::size_t smallest = least(golden.bundle(), "float32");
  const auto load_and_act = [&]() -> Status {
    VLA_TRY(const auto engine, Engine::load(golden.bundle(), {.kernels = "float32", .memory = smallest}));
    for (int i = 0; i < 2; ++i) {
      const auto chunk = engine->act(golden.observation, golden.noise);
      if (!chunk) {
        CHECK(!engine->act(golden.observation, golden.noise).ok());  // a device that failed once fails
        return chunk.error();
      }
    }
    return {};
  };
  const auto reset = [] {
    test::cuda::reset_fake_driver();
    fake_driver().computes = false;
  };
  reset();
  fake_driver().logs = true;
  REQUIRE(load_and_act());
  const std::vector<std::string> log = fake_driver().log;
  std::map<std::string, std::vector<long>> by_symbol;
  for (std::size_t i = 0; i < log.size(); ++i) by_symbol[log[i]].push_back(static_cast<long>(i) + 1);
  for (const auto& [symbol, all] : by_symbol)
    for (const long number : {all.front(), all[all.size() / 2], all[all.size() * 3 / 4], all.back()}) {
      CAPTURE(symbol);
      CAPTURE(number);
      reset();
      fake_driver().fail_at = number;
      const Status status = load_and_act();
      CHECK(fake_driver().used == 0);
      CHECK(fake_driver().n_handle == 0);
      if (!status) CHECK(status.error().code == Code::device);
      for (const char* copies : {"cuMemcpyHtoD", "cuGraphLaunch", "cuStreamWaitEvent", "cuStreamSync", "cuEventRecord"})
        if (symbol.starts_with(copies)) CHECK(!status.ok());
    }
}

}  // namespace stream_test
