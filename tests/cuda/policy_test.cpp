// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// What whole policies ask of the driver, and what they say when it refuses. Kernels are counted here, not computed.
#include <doctest/doctest.h>

#include <cstdlib>
#include <future>
#include <map>
#include <set>

#include "cuda/fake_driver.h"
#include "cuda/machine.h"
#include "lower/cuda/cuda_device.h"
#include "support/golden_case.h"

namespace policy_test {

using namespace vla;
using namespace vla::test;
using test::cuda::fake_driver;

namespace {

using Counts = std::map<std::string, long>;

/// One golden case of each family.
std::vector<std::string> families() {
  std::map<std::string, std::string> first;
  for (const std::string& path : golden_paths()) {
    const std::size_t name = path.rfind('/'), family = path.rfind('/', name - 1);
    first.emplace(path.substr(family + 1, name - family - 1), path);
  }
  std::vector<std::string> paths;
  for (const auto& [family, path] : first) paths.push_back(path);
  return paths;
}
GoldenCase small_case() {
  for (const std::string& path : golden_paths())
    if (path.ends_with("/smolvla/one_view")) return GoldenCase::read(path);
  FAIL("no such case");
  return {};
}

/// As it was, for tests of other files.
struct Driver {
  ~Driver() { test::cuda::reset_fake_driver(); }
};
void reset_without_computing() {
  test::cuda::reset_fake_driver();
  fake_driver().computes = false;
}

/// What was asked since `before`, but for what asks nothing of the device.
Counts calls_since(const Counts& before) {
  Counts since;
  for (const auto& [symbol, n] : fake_driver().n_call) {
    const auto found = before.find(symbol);
    const long more = n - (found != before.end() ? found->second : 0);
    if (more > 0 && symbol != "cuCtxSetCurrent" && symbol != "cuEventElapsedTime") since[symbol] = more;
  }
  return since;
}
const Counts kAct = {
    {"cuMemcpyHtoDAsync_v2", 1}, {"cuGraphLaunch", 1}, {"cuMemcpyDtoHAsync_v2", 1}, {"cuStreamSynchronize", 1}};

/// As the server does it, while the act before is computed.
Status encode(const Engine& engine, const GoldenCase& golden, EncodedObservation& to) {
  VLA_CHECK(engine.encode(golden.observation, golden.noise, {}, to));
  return engine.send_ahead(to);
}

/// Everything that a program does with a policy: the first error, or none. A server prepares an act before the one
/// before is computed.
Status load_and_act(const GoldenCase& golden) {
  VLA_TRY(const auto engine, Engine::load(golden.bundle(), {.kernels = "float32"}));
  Status first;
  const auto check = [&](const Result<ActionChunk>& chunk) {
    if (!first) {
      REQUIRE(!chunk.ok());  // a device that failed once fails
      CHECK(chunk.error().message() == first.error().message());
    }
    if (!chunk && first) first = chunk.error();
  };
  for (int i = 0; i < 2; ++i) check(engine->act(golden.observation, golden.noise));
  EncodedObservation encoded[2];
  for (EncodedObservation& one : encoded) VLA_CHECK(encode(*engine, golden, one));
  for (EncodedObservation& one : encoded) check(engine->compute(one));
  return first;
}

bool gives_back(const std::string& symbol) {
  for (const char* word : {"Free", "Destroy", "Unload", "Release", "SetCurrent"})
    if (symbol.find(word) != symbol.npos) return true;
  return false;
}
bool nothing_is_held() { return fake_driver().used == 0 && fake_driver().n_handle == 0; }

/// The numbers of calls that are made to fail: of each function the first, the last and one between, or all of them.
std::set<long> calls_to_fail(const std::vector<std::string>& log) {
  std::map<std::string, std::vector<long>> by_symbol;
  for (std::size_t i = 0; i < log.size(); ++i) by_symbol[log[i]].push_back(static_cast<long>(i) + 1);
  std::set<long> numbers;
  for (const auto& [symbol, all] : by_symbol)
    if (std::getenv("VLA_ALL_FAULTS") != nullptr)
      numbers.insert(all.begin(), all.end());
    else
      numbers.insert({all.front(), all[all.size() / 2], all.back()});
  return numbers;
}

}  // namespace

TEST_CASE_FIXTURE(Driver,
                  "an act is one upload, one launch and one download, whatever the family, and takes no memory") {
  for (const std::string& path : families()) {
    CAPTURE(path);
    reset_without_computing();
    const GoldenCase golden = GoldenCase::read(path);
    const auto engine = load_engine(golden.bundle(), "", "float32");
    if (engine->robot().solver().decodes) continue;  // reads each token back
    for (int i = 0; i < 3; ++i) {
      const Counts before = fake_driver().n_call;
      const auto chunk = engine->act(golden.observation, golden.noise);
      REQUIRE_MESSAGE(chunk.ok(), (chunk ? "" : chunk.error().message()));
      if (i > 0) CHECK(calls_since(before) == kAct);
    }
    CHECK(fake_driver().refused.empty());
  }
}

TEST_CASE_FIXTURE(Driver, "so is an act that continues the last chunk, after another, and one of another shape") {
  reset_without_computing();
  const GoldenCase golden = small_case();
  GoldenCase other = small_case();
  other.observation.text = "go";
  const auto engine = load_engine(golden.bundle(), "", "float32");
  const auto first = engine->act(golden.observation, golden.noise);
  REQUIRE(first.ok());
  const std::size_t d = static_cast<std::size_t>(first->d_action);
  const Leftover leftover = {
      {first->normalized.begin() + static_cast<std::ptrdiff_t>(2 * d), first->normalized.end()}, 1, "linear", 5.0};
  for (int i = 0; i < 3; ++i) {
    const Counts before = fake_driver().n_call;
    REQUIRE(engine->act(golden.observation, golden.noise, leftover).ok());
    REQUIRE(engine->act(other.observation, other.noise).ok());
    const Counts twice = {
        {"cuMemcpyHtoDAsync_v2", 2}, {"cuGraphLaunch", 2}, {"cuMemcpyDtoHAsync_v2", 2}, {"cuStreamSynchronize", 2}};
    if (i > 0) CHECK(calls_since(before) == twice);
  }
}

TEST_CASE_FIXTURE(Driver, "an act of a size that was warmed up makes no graph, also one that continues a chunk") {
  reset_without_computing();
  GoldenCase golden = small_case();
  std::vector<ActShape> sizes;
  std::optional<Leftover> leftover;
  {
    const auto engine = load_engine(golden.bundle(), "", "float32");
    CHECK(!engine->last_shape());
    for (const char* text : {"go", "put the cube into the basket"}) {
      golden.observation.text = text;
      const auto chunk = engine->act(golden.observation, golden.noise, leftover);
      REQUIRE(chunk.ok());
      sizes.push_back(*engine->last_shape());
      const auto skipped = static_cast<std::ptrdiff_t>(2 * chunk->d_action);
      leftover = {{chunk->normalized.begin() + skipped, chunk->normalized.end()}, 1, "linear", 5.0};
    }
  }
  CHECK(sizes[0].inputs.n_text < sizes[1].inputs.n_text);
  const auto engine = load_engine(golden.bundle(), "", "float32");
  for (const ActShape& size : sizes) REQUIRE(engine->warm_up(size));
  const Counts before = fake_driver().n_call;
  REQUIRE(engine->act(golden.observation, golden.noise, leftover).ok());
  Counts first = kAct;
  first["cuMemHostAlloc"] = 1;  // of the images, which later acts keep
  CHECK(calls_since(before) == first);
  golden.observation.text = "to";
  CHECK(engine->act(golden.observation, golden.noise).ok());
  CHECK(calls_since(before)["cuGraphInstantiateWithFlags"] == 0);

  ActShape other = sizes[0];
  other.inputs.n_text = 100000;
  CHECK(engine->warm_up(other).error().code == Code::bad_observation);
  other = sizes[0], other.embodiment = "absent";
  CHECK(engine->warm_up(other).error().code == Code::bad_observation);
}

TEST_CASE_FIXTURE(Driver, "an observation keeps the memory of its images, also when the engine is gone") {
  reset_without_computing();
  const GoldenCase golden = small_case();
  {
    EncodedObservation act;
    {
      const auto engine = load_engine(golden.bundle(), "", "float32");
      REQUIRE(engine->encode(golden.observation, golden.noise, {}, act).ok());
      const float* pixels = act.inputs.pixels.data();
      REQUIRE(engine->encode(golden.observation, golden.noise, {}, act).ok());
      CHECK(act.inputs.pixels.data() == pixels);
    }
    CHECK(act.inputs.pixels.front() >= -1);
    CHECK_FALSE(nothing_is_held());
  }
  CHECK(nothing_is_held());
}

TEST_CASE_FIXTURE(Driver, "images of an act that is prepared travel before the act before is computed") {
  reset_without_computing();
  const GoldenCase golden = small_case();
  const auto engine = load_engine(golden.bundle(), "", "float32");
  EncodedObservation acts[2];
  const auto prepare = [&](int i) { REQUIRE(encode(*engine, golden, acts[i % 2]).ok()); };
  prepare(0);
  for (int i = 0; i < 5; ++i) {
    Counts before = fake_driver().n_call;
    prepare(i + 1);
    const Counts sent = {{"cuMemcpyHtoDAsync_v2", 1}, {"cuEventRecord", 1}};
    if (i > 0) CHECK(calls_since(before) == sent);
    before = fake_driver().n_call;
    REQUIRE(engine->compute(acts[i % 2]).ok());
    Counts computed = kAct;  // the upload is of what is small
    computed["cuStreamWaitEvent"] = computed["cuMemcpyDtoDAsync_v2"] = 1;
    if (i > 1) CHECK(calls_since(before) == computed);
  }
}

TEST_CASE_FIXTURE(Driver, "acts that another thread prepares meanwhile answer what they answer alone") {
  test::cuda::reset_fake_driver();
  const GoldenCase golden = small_case();
  GoldenCase dark = small_case();
  for (auto& [view, frame] : dark.observation.views)
    std::visit([](auto& numbers) { std::fill(numbers.begin(), numbers.end(), 0); }, frame->rgb);
  const auto engine = load_engine(golden.bundle(), "", "float32");
  const auto alone = [&](const GoldenCase& one) { return engine->act(one.observation, one.noise)->actions; };
  const std::vector<float> expected[2] = {alone(golden), alone(dark)};
  CHECK(expected[0] != expected[1]);
  EncodedObservation acts[2];
  const auto prepare = [&](int i) { return encode(*engine, i % 2 == 0 ? golden : dark, acts[i % 2]).ok(); };
  REQUIRE(prepare(0));
  for (int i = 0; i < 4; ++i) {
    auto next = std::async(std::launch::async, prepare, i + 1);
    const auto chunk = engine->compute(acts[i % 2]);
    REQUIRE(next.get());
    REQUIRE_MESSAGE(chunk.ok(), (chunk ? "" : chunk.error().message()));
    CHECK(chunk->actions == expected[i % 2]);
  }
  for (int i = 0; i < 6; ++i) {  // at once: the images are still on their way
    REQUIRE(prepare(i));
    CHECK(engine->compute(acts[i % 2])->actions == expected[i % 2]);
  }
  // One that nobody computes leaves its memory to the next, and one for which memory is short is uploaded in its turn.
  REQUIRE(prepare(1));
  REQUIRE(prepare(1));
  CHECK(engine->compute(acts[1])->actions == expected[1]);
  EncodedObservation third;
  fake_driver().memory = fake_driver().used;
  REQUIRE((prepare(0) && prepare(1)));
  REQUIRE(encode(*engine, golden, third).ok());
  CHECK(third.pixels_ahead == nullptr);
  CHECK(engine->compute(third)->actions == expected[0]);
}

TEST_CASE_FIXTURE(Driver, "stages have the device's times, one after the other") {
  test::cuda::reset_fake_driver();
  const GoldenCase golden = small_case();
  const auto engine = load_engine(golden.bundle(), "", "float32");
  const auto chunk = engine->act(golden.observation, golden.noise);
  REQUIRE(chunk.ok());
  double n_timed = 0;
  for (const auto& [stage, ms] : chunk->timing) {
    CAPTURE(stage);
    CHECK(ms >= 0);
    n_timed += (stage == "vision" || stage == "prefix" || stage == "steps") && ms > 0.1;
  }
  CHECK(n_timed == 3);
}

TEST_CASE_FIXTURE(
    Driver, "any call of the driver that fails under a whole policy is a typed error, then and for every later act") {
  const GoldenCase golden = small_case();
  reset_without_computing();
  fake_driver().logs = true;
  REQUIRE(load_and_act(golden));
  CHECK(nothing_is_held());
  const std::vector<std::string> log = fake_driver().log;
  for (const long number : calls_to_fail(log))
    for (const bool is_lost : {false, true}) {
      CAPTURE(number);
      CAPTURE(log[static_cast<std::size_t>(number - 1)]);
      reset_without_computing();
      fake_driver().fail_at = number, fake_driver().is_lost_then = is_lost;
      const Status status = load_and_act(golden);
      CHECK(nothing_is_held());
      CHECK(status.ok() <= gives_back(log[static_cast<std::size_t>(number - 1)]));
      if (!status) CHECK(status.error().code == Code::device);
    }
}

TEST_CASE_FIXTURE(Driver,
                  "where memory is too little, the error says for what, how much it takes and how much there is") {
  const GoldenCase golden = small_case();
  reset_without_computing();
  std::size_t needed = 0;
  {
    const auto engine = load_engine(golden.bundle(), "", "float32");
    needed = fake_driver().used;
  }
  std::set<std::string> what;
  for (std::size_t part = 0; part < 24; ++part) {
    reset_without_computing();
    fake_driver().memory = needed * part / 24;
    const auto engine = Engine::load(golden.bundle(), {.kernels = "float32"});
    REQUIRE(!engine.ok());
    CHECK(engine.error().code == Code::out_of_memory);
    CHECK(engine.error().expected.find("bytes of device memory") != std::string::npos);
    CHECK(engine.error().found.find(" free") != std::string::npos);
    what.insert(engine.error().where);
    CHECK(nothing_is_held());
  }
  CHECK(what.contains("weights"));
  CHECK(what.size() > 1);
}

TEST_CASE_FIXTURE(Driver, "how much memory is needed is told without taking it") {
  const GoldenCase golden = small_case();
  reset_without_computing();
  const auto filled = load_engine(golden.bundle(), "", "float32");
  const std::size_t used = fake_driver().used;
  const auto dry = Engine::load(golden.bundle(), {.kernels = "float32", .dry = true});
  REQUIRE(dry.ok());
  CHECK((*dry)->memory().total() == filled->memory().total());
  CHECK(fake_driver().used == used);
  CHECK(filled->memory().total() <= used);
}

TEST_CASE_FIXTURE(Driver, "an old driver and an old GPU are refused when a policy is loaded") {
  const GoldenCase golden = small_case();
  const auto message = [&](auto change) {
    reset_without_computing();
    change(fake_driver());
    const auto engine = Engine::load(golden.bundle(), {.kernels = "float32"});
    CHECK(nothing_is_held());
    return engine ? "" : engine.error().message();
  };
  CHECK(message([](test::cuda::FakeDriver& d) { d.version = 12040; }) ==
        "cuda: expected a driver for CUDA 12.6 or newer, found one for CUDA 12.4");
  CHECK(message([](test::cuda::FakeDriver& d) { d.major = 7, d.minor = 5; }) ==
        "cuda:0: expected compute capability 8.0 or newer (Ampere), found 7.5");
}

TEST_CASE_FIXTURE(Driver, "a model of a GPU says how long an act takes there: longer for more, and on less") {
  const auto seconds = [](const std::string& bundle, const std::string& model, int n_step) {
    const auto engine = Engine::load(bundle, {.kernels = "model:" + model, .dry = true});
    REQUIRE_MESSAGE(engine.ok(), (engine ? "" : engine.error().message()));
    REQUIRE((*engine)->set_steps(n_step));
    const auto stages = (*engine)->predict();
    REQUIRE(stages.ok());
    double sum = 0;
    for (const auto& [stage, prediction] : *stages) {
      CAPTURE(stage);
      CHECK(prediction.n_launch > 0);
      CHECK(prediction.seconds >= std::max(prediction.products, prediction.bytes));
      sum += prediction.seconds;
    }
    CHECK(stages->back().first == "steps");
    return sum;
  };
  const std::string bundle = small_case().bundle();
  CHECK(seconds(bundle, "orin-agx", 10) > 1.5 * seconds(bundle, "orin-agx", 5));
  CHECK(seconds(bundle, "orin-agx", 10) > seconds(bundle, "h100", 10));
  CHECK(!Engine::load(bundle, {.kernels = "model:h100"}).ok());  // it holds no weights
  const auto absent = Engine::load(bundle, {.kernels = "model:tpu", .dry = true});
  REQUIRE(!absent.ok());
  CHECK(absent.error().expected == "one of orin-agx, rtx-3060, rtx-5090, h100, h200");
}

}  // namespace policy_test
