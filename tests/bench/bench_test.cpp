// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bench/bench.h"

#include <doctest/doctest.h>

#include <cmath>
#include <sstream>

#include "bench/doctor.h"
#include "bench/roofline.h"
#include "bench/versus.h"
#include "policies/policy.h"
#include "support/editable_bundle.h"

namespace bench_test {

using namespace vla;
using namespace vla::bench;

namespace {

/// A series whose network takes 5 ms and 2 ms for each step, with one slow round.
Series series_of(int n_step) {
  Series series;
  series.n_step = n_step;
  series.peak_name = "some f32";
  series.work = {{"prefix", {4e9, 1e9}}, {"steps", {n_step * 1e9, n_step * 1e9}}};
  for (double extra : {0.0, 0.0, 1.0})
    series.rounds.push_back({{{"decode", 1.0}, {"prefix", 5.0 + extra}, {"steps", 2.0 * n_step}}, 2e12, 2.0});
  return series;
}

Report report_of(const Series& series) {
  Report report;
  report.conditions = {"smolvla", "bf16", "a <source> & more", 2, 512, 512, 48, series.n_step,
                       2,         "avx2", "cpu, 2 threads"};
  report.cpu = "a processor";
  report.before.peaks = {{"other f32", 1e11, 2e11}, {"some f32", 1e12, 2e12}};
  report.before.bandwidth = 1e12;
  report.after = report.before;
  summarize(series, report);
  return report;
}

Report report_of(int n_step) { return report_of(series_of(n_step)); }

/// The network of the small policy that comes with the project, as an architecture would publish it.
Keys small_network() {
  const auto bundle = Bundle::open(test::source_path("models/metaworld-tiny.gguf"));
  REQUIRE(bundle.ok());
  Keys keys;
  for (const auto& [key, value] : bundle->keys().all())
    for (const char* part : {"policy.", "vision.", "connector.", "lm.", "expert.", "time."})
      if (key.starts_with(part)) keys.set(key, value);
  return keys;
}

}  // namespace

TEST_CASE("quantiles interpolate between neighbours") {
  CHECK(quantile({4, 1, 3, 2}, 0.5) == 2.5);
  CHECK(quantile({4, 1, 3, 2}, 0) == 1);
  CHECK(quantile({4, 1, 3, 2}, 1) == 4);
  CHECK(quantile({7}, 0.9) == 7);
}

TEST_CASE("a line through several numbers of steps separates the prefix from a step") {
  const StepFit fit = fit_steps({series_of(1), series_of(5), series_of(10)});
  CHECK(fit.prefix == doctest::Approx(5));
  CHECK(fit.step == doctest::Approx(2));
  CHECK(fit.worst == doctest::Approx(0));
  CHECK(fit.points[1] == std::pair(5, 15.0));
}

TEST_CASE("rates and shares follow from work, time and the peak beside each round") {
  const Report report = report_of(10);
  const StageRow& prefix = *report.find("prefix");
  CHECK(prefix.p50 == 5);
  CHECK(prefix.flop_rate == doctest::Approx(4e9 / 5e-3));
  CHECK(prefix.share_of_peak_p50 == doctest::Approx(0.4));
  CHECK(prefix.share_of_bandwidth == doctest::Approx(0.2));
  CHECK(report.regime(prefix) == "compute");                // 4 operations a byte, where 2 are the ridge
  CHECK(report.regime(*report.find("steps")) == "memory");  // 1
  CHECK(report.regime(*report.find("decode")) == "host");
  CHECK(report.find("network")->p50 == 25);
  CHECK(report.find("total")->p50 == 26);
  CHECK(report.find("network")->work.flop == doctest::Approx(14e9));
}

TEST_CASE("the floor of a stage is its arithmetic at peak or its weights at bandwidth, whichever is longer") {
  Series series = series_of(10);
  CHECK(report_of(series).find("prefix")->floor == doctest::Approx(2));  // 4e9 operations at 2e12 a second
  CHECK(report_of(series).find("prefix")->above_floor() == doctest::Approx(2.5));
  series.work[1].second.weights = 1e10;  // at 1e12 bytes a second
  CHECK(report_of(series).find("steps")->floor == doctest::Approx(10));
  CHECK(report_of(series).find("decode")->floor == 0);
  CHECK(to_text(report_of(series)).find("2.50 x") != std::string::npos);
}

TEST_CASE("what the kinds of operations took is reported as shares of all that was counted") {
  Series series = series_of(10);
  CHECK(to_text(report_of(series)).find("time of the threads") == std::string::npos);
  series.times = {{"products", 3.0}, {"attention", 1.0}};
  CHECK(to_text(report_of(series)).find("time of the threads: products 75.0 %, attention 25.0 %") != std::string::npos);
  CHECK(to_json(report_of(series)).find(R"("shares":{"products":0.75,"attention":0.25})") != std::string::npos);
}

TEST_CASE("products of int8 codes refer to a peak of their own") {
  Series series = series_of(10);
  series.int8_peak_name = "some int8";
  for (Round& round : series.rounds) round.int8_peak = 6e12;
  series.work[0].second.int8 = 3e9;  // of 4e9: half a millisecond at each peak
  const Report report = report_of(series);
  CHECK(report.find("prefix")->floor == doctest::Approx(1));
  CHECK(report.find("prefix")->share_of_peak_p50 == doctest::Approx(0.2));
  CHECK(report.find("steps")->floor == doctest::Approx(5));
  CHECK(to_json(report).find("\"int8_peak_gops\":6000.0") != std::string::npos);
}

TEST_CASE("cores of ARM64 are named by their numbers, and counted") {
  const std::string little = "processor : 0\nCPU implementer\t: 0x41\nCPU part\t: 0xd05\n",
                    big = "processor : 1\nCPU implementer\t: 0x41\nCPU part\t: 0xd0b\n",
                    other = "CPU implementer\t: 0x61\nCPU part\t: 0xd0b\n";
  std::istringstream rk3588(little + little + big + little + big), unknown(other), x86("model name : AMD EPYC\n");
  CHECK(arm_cores(rk3588) == "3 Cortex-A55, 2 Cortex-A76");
  CHECK(arm_cores(unknown) == "1 core 0x61:0xd0b");
  CHECK(arm_cores(x86).empty());
}

TEST_CASE("rounds that had less of the machine than most are named") {
  Series series = series_of(10);
  const auto marked = [&] {
    const Report report = report_of(series);
    std::vector<bool> all;
    for (const Round& round : report.rounds) all.push_back(report.is_disturbed(round));
    return all;
  };
  CHECK(marked() == std::vector<bool>{false, false, false});
  CHECK(to_text(report_of(series)).find("disturbed") == std::string::npos);
  series.rounds[1].cores = 1.7;
  series.rounds[2].peak = 1.7e12;
  CHECK(marked() == std::vector<bool>{false, true, true});
  CHECK(to_text(report_of(series)).find("disturbed: rounds 2, 3") != std::string::npos);
}

TEST_CASE("a peak that was disturbed does not flatter its round") {
  Series series = series_of(10);
  series.rounds[0].peak /= 2;
  CHECK(report_of(series).find("prefix")->share_of_peak == doctest::Approx(0.4));
}

TEST_CASE("the roofline names every roof and stage, and escapes what would end its markup") {
  Report report = report_of(10);
  report.cpu = "one < two & \"three\"";
  const std::string svg = draw_roofline(report);
  for (const char* text : {">prefix</text>", ">steps</text>", ">network</text>", "some f32, all threads: 2000 G/s",
                           "some f32, one thread: 1000 G/s", "other f32, all threads", "memory: 1e+03 GB/s",
                           "one &lt; two &amp;", "2 threads"})
    CHECK_MESSAGE(svg.find(text) != std::string::npos, text);
  CHECK(svg.find("nan") == std::string::npos);
}

TEST_CASE("an earlier report is compared stage by stage, and only with the same work") {
  const std::string path = test::write_file("earlier.json", "first line\n" + to_json(report_of(10)) + "\n");
  const auto earlier = Earlier::read(path);
  REQUIRE(earlier.ok());
  Report now = report_of(10);
  CHECK(earlier->check(now.conditions).ok());
  CHECK(earlier->compare(now).find("1.00 times as fast") != std::string::npos);
  CHECK(earlier->compare(now).find("warning") == std::string::npos);
  now.before.peaks[1].all *= 1.1;
  CHECK(earlier->compare(now).find("warning: the machine's own peak was 2000.0 GFLOP/s") != std::string::npos);
  CHECK(earlier->check(report_of(5).conditions).error().code == Code::usage);
}

TEST_CASE("what is no report is refused as one") {
  for (const char* text : {"", "{}", "[1, 2]", "not JSON", "{\"conditions\": {\"policy\": 3}}"})
    CHECK(Earlier::read(test::write_file("no_report.json", text)).error().code == Code::usage);
  CHECK(Earlier::read("/nothing/here").error().code == Code::io);
}

TEST_CASE("a random bundle of every dtype passes every check of a bundle and answers with finite actions") {
  for (DType type : {DType::bf16, DType::f16, DType::f32}) {
    CAPTURE(dtype_name(type));
    const auto random = RandomBundle::make("smolvla", small_network(), {3, 17, 2, type, 1});
    REQUIRE(random.ok());
    const auto engine = Engine::load(random->path(), {.n_thread = 1});
    REQUIRE_MESSAGE(engine.ok(), engine.error().message());
    const Engine& loaded = **engine;
    CHECK(loaded.robot().processor().views().names().size() == 3);
    CHECK(loaded.robot().solver().n_step == 2);
    auto workload = Workload::make(loaded.robot().processor(), {2, 40, 30, 17});
    REQUIRE(workload.ok());
    REQUIRE(workload->decode().ok());
    CHECK(std::get<0>(workload->observation().views.at("observation.images.view1")->rgb).size() == 40 * 30 * 3);
    const auto chunk = (*engine)->act(workload->observation(), std::uint64_t{1});
    REQUIRE_MESSAGE(chunk.ok(), chunk.error().message());
    bool moves = false;
    for (float value : chunk->actions) moves = moves || value != chunk->actions.front();
    CHECK(moves);
  }
}

TEST_CASE("an instruction has exactly the tokens that were asked for") {
  const auto bundle = Bundle::open(test::source_path("models/metaworld-tiny.gguf"));
  REQUIRE(bundle.ok());
  const auto processor = Processor::create(*bundle);
  REQUIRE(processor.ok());
  for (int n_text : {3, 7, processor->recipe().max_tokens}) {
    const auto workload = Workload::make(*processor, {1, 0, 0, n_text});
    REQUIRE(workload.ok());
    Inputs inputs;
    REQUIRE(processor->encode_text(workload->observation(), inputs).ok());
    CHECK(static_cast<int>(inputs.tokens.size()) == n_text);
  }
  CHECK(Workload::make(*processor, {1, 0, 0, 4000}).error().code == Code::usage);
  CHECK(Workload::make(*processor, {5, 0, 0, 7}).error().where == "--views");
}

TEST_CASE("a policy that takes one camera's frames alone, and one whose prompt tells the state, get what they take") {
  for (const char* name : {"gr00t_n1_5/arms", "pi05/two_views"}) {
    CAPTURE(name);
    const auto bundle = Bundle::open(test::golden_path(name + std::string("/bundle.gguf")));
    REQUIRE(bundle.ok());
    const auto processor = Processor::create(*bundle);
    REQUIRE(processor.ok());
    auto workload = Workload::make(*processor, {});
    REQUIRE_MESSAGE(workload.ok(), (workload ? "" : workload.error().message()));
    REQUIRE(workload->decode().ok());
    const auto inputs = processor->encode(workload->observation());
    REQUIRE_MESSAGE(inputs.ok(), (inputs ? "" : inputs.error().message()));
    CHECK(static_cast<int>(inputs->tokens.size()) == processor->recipe().max_tokens);
  }
}

TEST_CASE("a rate is held while a chunk lasts until the next one is there") {
  Checkup checkup;
  checkup.horizon = 16, checkup.rate_hz = 80, checkup.total = 190;
  CHECK(checkup.replan_rows() == 16);
  CHECK(checkup.holds_rate());
  checkup.total = 201;
  CHECK_FALSE(checkup.holds_rate());
  checkup.one_thread = 100;  // the fewer threads where they are faster
  CHECK(checkup.replan_rows() == 8);
  CHECK(checkup.holds_rate());
  checkup.rate_hz = 0, checkup.one_thread = 0;
  CHECK(checkup.holds_rate());
}

}  // namespace bench_test
