// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/driver/gpu.h"

#include <doctest/doctest.h>

#include <cmath>

#include "cuda/fake_driver.h"
#include "cuda/kernels/map.h"
#include "cuda/kernels/rows.h"
#include "cuda/machine.h"

namespace gpu_test {

using namespace vla;
using namespace vla::cuda;
using namespace vla::test::cuda;

namespace {

/// y = norm(x) + norm(z), row by row, whose norms are forked streams of one captured graph that is launched `n_launch`
/// times; x and z grow by one number between.
class Program {
 public:
  explicit Program(int n_launch = 2) : n_launch_(n_launch) {}

  Status run(std::vector<float>& y) {
    VLA_TRY(std::unique_ptr<Gpu> gpu, Gpu::open(fake_driver_table(), 0, modules_of_tests()));
    VLA_TRY(Stream main, gpu->stream());
    VLA_TRY(Stream side, gpu->stream());
    VLA_TRY(const Buffer memory, gpu->allocate(5 * kBytes, "working memory"));
    VLA_TRY(const Owned pinned, gpu->allocate_host(2 * kBytes));
    auto* x = static_cast<float*>(pinned.get());
    const auto norm = [&](std::size_t from, std::size_t to) {
      return NormJob{memory.as<float>(from * kBytes),
                     nullptr,
                     nullptr,
                     nullptr,
                     nullptr,
                     memory.as<float>(to * kBytes),
                     kWidth,
                     kWidth,
                     kRows,
                     kWidth,
                     1e-6f,
                     RowNorm::rms,
                     RowType::f32};
    };
    const NormJob one = norm(0, 2), other = norm(1, 3);
    const MapJob add = {memory.as<float>(2 * kBytes),
                        memory.as<float>(3 * kBytes),
                        memory.as<float>(4 * kBytes),
                        {kWidth * kRows, 1, 1, 1, 1, 1},
                        {1},
                        {1},
                        {1},
                        1,
                        MapOperation::add,
                        Activation::none,
                        false};
    for (const Launch& kernel : {norm_rows(one), norm_rows(other), map_elements(add)}) VLA_CHECK(gpu->prepare(kernel));
    VLA_CHECK(main.begin_capture());
    VLA_CHECK(side.after(main));
    VLA_CHECK(main.launch(norm_rows(one), one));
    VLA_CHECK(side.launch(norm_rows(other), other));
    VLA_CHECK(main.after(side));
    VLA_CHECK(main.launch(map_elements(add), add));
    VLA_TRY(const Owned graph, main.end_capture());

    y.assign(kWidth * kRows, 0);
    for (int i = 0; i < n_launch_; ++i) {
      for (int k = 0; k < 2 * kWidth * kRows; ++k) x[k] = static_cast<float>(k % 7 + i + 1);
      VLA_CHECK(main.upload(memory.address(), x, 2 * kBytes));
      VLA_CHECK(main.launch(graph));
      VLA_CHECK(main.download(y.data(), memory.address() + 4 * kBytes, kBytes));
      VLA_CHECK(main.wait());
    }
    return {};
  }

  std::vector<float> expected() const {
    std::vector<float> y;
    for (int row = 0; row < kRows; ++row)
      for (int i = 0; i < kWidth; ++i) {
        double sum = 0;
        for (int part : {row, kRows + row}) {
          double squares = 0;
          const auto x = [&](int k) { return static_cast<double>((part * kWidth + k) % 7 + n_launch_); };
          for (int k = 0; k < kWidth; ++k) squares += x(k) * x(k) / kWidth;
          sum += x(i) / std::sqrt(squares + 1e-6);
        }
        y.push_back(static_cast<float>(sum));
      }
    return y;
  }

 private:
  static constexpr int kWidth = 40, kRows = 3;
  static constexpr std::size_t kBytes = 4 * kWidth * kRows;
  int n_launch_;
};

bool nothing_held() { return fake_driver().used == 0 && fake_driver().n_handle == 0; }

}  // namespace

TEST_CASE("a captured graph of forked streams runs as often as it is launched, in any order that events allow") {
  for (int i = 0; i < 4; ++i) {
    reset_fake_driver();
    std::vector<float> y;
    Program program(3);
    const Status status = program.run(y);
    REQUIRE_MESSAGE(status, (status ? "" : status.error().message() + fake_driver().fault));
    const std::vector<float> expected = program.expected();
    for (std::size_t k = 0; k < y.size(); ++k) CHECK(y[k] == doctest::Approx(expected[k]).epsilon(1e-5));
    CHECK(nothing_held());
    CHECK(fake_driver().refused.empty());
    CHECK(fake_driver().n_call["cuModuleGetFunction"] == 2);
    CHECK(fake_driver().n_call["cuMemAlloc_v2"] == 1);
    CHECK(fake_driver().n_call["cuLaunchKernelEx"] == 3);
    CHECK(fake_driver().n_call["cuGraphLaunch"] == 3);
    CHECK(fake_driver().n_call["cuStreamSynchronize"] == 3);
  }
}

TEST_CASE("any call of the driver that fails is a typed error that names it, and everything is given back") {
  reset_fake_driver();
  std::vector<float> y;
  REQUIRE(Program().run(y));
  const long n_call = fake_driver().n_calls;
  for (bool is_lost_then : {false, true})
    for (int failure : {kOutOfMemory, kLaunchFailed})
      for (long i = 1; i <= n_call; ++i) {
        reset_fake_driver();
        fake_driver().fail_at = i, fake_driver().failure = failure, fake_driver().is_lost_then = is_lost_then;
        const Status status = Program().run(y);
        INFO("call ", i, " of ", n_call);
        CHECK(nothing_held());
        if (status) {  // what gives back has no use for an error
          const std::string& call = fake_driver().failed_call;
          CHECK((call.find("Destroy") != call.npos || call.find("Free") != call.npos ||
                 call.find("Unload") != call.npos || call.find("Release") != call.npos ||
                 call.find("SetCurrent") != call.npos));
          continue;
        }
        CHECK(status.error().where.find(failure == kOutOfMemory && status.error().where == "working memory"
                                            ? "memory"
                                            : "cuda ") != std::string::npos);
        if (!is_lost_then) CHECK(status.error().code == (failure == kOutOfMemory ? Code::out_of_memory : Code::device));
      }
}

TEST_CASE("what a device lacks is refused with what was expected and found") {
  std::vector<float> y;
  const auto message = [&](auto change) {
    reset_fake_driver();
    change(fake_driver());
    const Status status = Program().run(y);
    return status ? std::string() : status.error().message();
  };
  CHECK(message([](FakeDriver& d) { d.version = 11040; }) ==
        "cuda: expected a driver for CUDA 12.6 or newer, found one for CUDA 11.4");
  CHECK(message([](FakeDriver& d) { d.n_device = 0; }) ==
        "cuda:0: expected a device below 0, found none of this number");
  CHECK(message([](FakeDriver& d) { d.major = 7, d.minor = 5; }) ==
        "cuda:0: expected compute capability 8.0 or newer (Ampere), found 7.5");
  CHECK(message([](FakeDriver& d) { d.memory = 1000; }) ==
        "working memory: expected 2400 bytes of device memory, found 1000 free");
  reset_fake_driver();
  const auto gpu = Gpu::open(fake_driver_table(), 0,
                             {".version 9.0\n.visible .entry k(\n.param .u64 p\n)\n{\nbrx.idx %r1, $x;\n}\n"});
  REQUIRE(!gpu);
  CHECK(gpu.error().where == "cuda module_load");
  CHECK(gpu.error().found.find("as the test wants it: ptxas application ptx input; " + fake_driver().fault) !=
        std::string::npos);
}

TEST_CASE("machine code is loaded by a driver that takes it on the architecture that it is of, else its PTX") {
  const auto ptx = [](const std::string& target, const std::string& kernel) {
    return ".target sm_" + target + "\n.address_size 64\n.visible .entry " + kernel +
           "(\n.param .align 8 .b8 p[8]\n)\n{\nret;\n}\n";
  };
  const std::string code = "\177ELF of ", forward = ".target sm_90\n", alone = ".target sm_90a";
  const std::vector<std::string> modules = {ptx("80", "map_elements"), ptx("90", "map_elements"), code + "90",
                                            ptx("90a", "norm_rows"), code + "90a"};
  using Images = std::vector<std::string>;
  struct Case {
    int version, capability;
    bool takes_machine_code;
    Images images;  // what is asked for, as it begins
  };
  for (const Case& one :
       {Case{13000, 90, true, {code + "90", code + "90a"}},
        Case{13000, 90, false, {code + "90", forward, code + "90a", alone}}, Case{12080, 90, true, {forward, alone}},
        Case{13000, 120, true, {forward}}, Case{13000, 87, true, {".target sm_80\n"}}}) {
    INFO(one.version, " ", one.capability, " ", one.takes_machine_code);
    reset_fake_driver();
    fake_driver().version = one.version, fake_driver().takes_machine_code = one.takes_machine_code;
    fake_driver().major = one.capability / 10, fake_driver().minor = one.capability % 10;
    const auto gpu = Gpu::open(fake_driver_table(), 0, modules);
    REQUIRE(gpu);
    const Images& asked = fake_driver().images;
    REQUIRE(asked.size() == one.images.size());
    for (std::size_t i = 0; i < asked.size(); ++i) CHECK(asked[i].starts_with(one.images[i]));
    CHECK((*gpu)->prepare({"map_elements", {}, 32}));
    const Status hopper = (*gpu)->prepare({"norm_rows", {}, 32});
    CHECK(hopper.ok() == (one.capability == 90));
    if (!hopper) CHECK(hopper.error().message() == "norm_rows: expected a kernel of a loaded module, found none");
    CHECK(fake_driver().refused.size() == (one.takes_machine_code ? 0 : 2));
  }
}

TEST_CASE("rows are mapped for a GPU as its driver takes them, or refused") {
  reset_fake_driver();
  auto gpu = Gpu::open(fake_driver_table(), 0, modules_of_tests());
  REQUIRE(gpu);
  auto memory = (*gpu)->allocate(4096, "rows");
  REQUIRE(memory);
  const auto* rows = memory->as<std::uint16_t>();
  TensorMap map = {};
  CHECK((*gpu)->map_rows({rows, 8, 61, 64, 256}, map).ok());
  CHECK(fake_driver().n_call["cuTensorMapEncodeTiled"] == 1);
  for (const MappedRows& refused :
       {MappedRows{rows + 4, 8, 64, 64, 8}, MappedRows{rows, 8, 60, 60, 8}, MappedRows{rows, 8, 72, 64, 8},
        MappedRows{rows, 8, 64, 64, 257}, MappedRows{rows, 8, 64, 64, 0}, MappedRows{rows, 0, 64, 64, 8}}) {
    const Status made = (*gpu)->map_rows(refused, map);
    REQUIRE(!made.ok());
    CHECK(made.error().message().find("cuda tensor_map: CUDA_ERROR_INVALID_VALUE") != std::string::npos);
  }
  const MappedHeads heads = {.data = rows,
                             .d_head = 24,
                             .n_head = 2,
                             .n_token = 3,
                             .n_batch = 2,
                             .head = 24,
                             .token = 72,
                             .batch = 216,
                             .box_columns = 16,
                             .box_tokens = 128};
  CHECK((*gpu)->map_heads(heads, map).ok());
  MappedHeads narrow = heads, apart = heads, uneven = heads;
  narrow.head = 16, apart.token = 80, uneven.d_head = 20, uneven.head = 20;
  for (const MappedHeads& refused : {narrow, apart, uneven}) CHECK(!(*gpu)->map_heads(refused, map).ok());
}

TEST_CASE("capturing refuses what no graph can hold, and a stream that is not waited for") {
  reset_fake_driver();
  auto gpu = Gpu::open(fake_driver_table(), 0, modules_of_tests());
  REQUIRE(gpu);
  auto main = (*gpu)->stream(), side = (*gpu)->stream();
  auto memory = (*gpu)->allocate(64, "memory");
  const MapJob job = {
      memory->as<float>(), nullptr, memory->as<float>(), {16, 1, 1, 1, 1, 1}, {1}, {}, {1}, 1, MapOperation::copy,
      Activation::none,    false};
  const Launch map = map_elements(job);
  const Launch large = {"linear_bf16_64", {}, 128, 96 << 10};
  REQUIRE((*gpu)->prepare(map));
  REQUIRE((*gpu)->prepare({large.kernel, {}, 128}));
  REQUIRE(main->begin_capture());
  CHECK(!(*gpu)->allocate(64, "memory"));
  CHECK(!(*gpu)->prepare({"norm_rows", {}, 32}));  // that the driver would load,
  CHECK(!(*gpu)->prepare(large));                  // or would give more shared memory
  CHECK(!main->wait());
  REQUIRE(side->after(*main));
  REQUIRE(side->launch(map, job));
  CHECK(!main->end_capture());
  CHECK(!main->launch({"absent", {}, 32}, job));
  CHECK(main->wait());
}

TEST_CASE("a launch in clusters is asked of a Hopper, and refused where it is not one or has no such cluster") {
  const auto refusal = [](unsigned cluster, unsigned z, int major) {
    reset_fake_driver();
    fake_driver().major = major;
    auto gpu = Gpu::open(fake_driver_table(), 0, modules_of_tests());
    REQUIRE(gpu);
    auto stream = (*gpu)->stream();
    auto memory = (*gpu)->allocate(64, "memory");
    MapJob job = {};
    job.a = memory->as<float>(), job.y = memory->as<float>();
    Launch how = {"map_elements", {1, 1, z}, 32};
    for (int i = 0; i < 2; ++i) {  // the second one may begin before the first ends
      how.cluster = i == 0 ? 1 : cluster;
      const Status status = stream->launch(how, job);
      if (!status) return status.error().message();
    }
    return std::string();
  };
  constexpr const char* kInvalid = "cuda launch: CUDA_ERROR_INVALID_CLUSTER_SIZE, as the test wants it";
  CHECK(refusal(1, 3, 9).empty());
  CHECK(refusal(2, 4, 9).empty());
  CHECK(refusal(8, 8, 9).empty());
  CHECK(refusal(9, 9, 9) == kInvalid);
  CHECK(refusal(2, 3, 9) == kInvalid);
  CHECK(refusal(2, 4, 12) == "map_elements: expected a Hopper, found a cluster elsewhere");
  reset_fake_driver();
}

TEST_CASE("a kernel that fails loses the device, for every later call") {
  reset_fake_driver();
  auto gpu = Gpu::open(fake_driver_table(), 0, modules_of_tests());
  REQUIRE(gpu);
  auto stream = (*gpu)->stream();
  auto memory = (*gpu)->allocate(512, "memory");
  NormJob job = {};
  job.x = memory->as<float>(), job.y = memory->as<float>(256), job.n_row = 1, job.n = 64;
  REQUIRE(stream->launch(Launch{"norm_rows", {}, 256, 0}, job));  // without the shared memory that it takes
  const Status status = stream->wait();
  REQUIRE(!status);
  CHECK(status.error().message() == "cuda stream_wait: CUDA_ERROR_LAUNCH_FAILED, as the test wants it");
  CHECK(fake_driver().fault.find("norm_rows") != std::string::npos);
  CHECK(!stream->wait());
  CHECK(!(*gpu)->allocate(16, "memory"));
}

TEST_CASE("without NVIDIA's driver there is a device error, not a crash") {
  const auto driver = load_driver();
  if (driver) return;  // a machine with a GPU
  CHECK(driver.error().code == Code::device);
  CHECK(driver.error().message().find("libcuda.so.1") != std::string::npos);
}

}  // namespace gpu_test
