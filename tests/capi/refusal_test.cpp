// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Bad arguments are a status and an error that names its place; the policy goes on.
#include <cstddef>
#include <cstring>
#include <limits>
#include <thread>

#include "capi/policy.h"

namespace refusal_test {

using namespace vla;
using namespace vla::test;

namespace {

void check_error(const vla_policy* policy, vla_status status, vla_status expected, const std::string& part) {
  const vla_error& error = *vla_last_error(policy);
  CAPTURE(error.message);
  CHECK(status == expected);
  CHECK(error.code == expected);
  CHECK(error.struct_size == sizeof error);
  CHECK(std::string(error.message).find(part) != std::string::npos);
  CHECK(std::string(error.message).find(error.where) == 0);
}

/// A bad call is refused, nothing comes out, and the sound call afterwards is answered.
void check_refused(const Call& bad, vla_status expected, const std::string& part) {
  const Call sound;
  const PolicyHandle policy = open_policy(sound.golden.bundle());
  auto* chunk = reinterpret_cast<vla_chunk*>(&expected);  // must not stay
  const vla_status status = vla_act(policy.get(), &bad.observation, &chunk);
  CHECK(chunk == nullptr);
  check_error(policy.get(), status, expected, part);
  CHECK_FALSE(actions_of(policy.get(), sound.observation).empty());
}

}  // namespace

TEST_CASE("NULL for any argument is refused, never followed") {
  Call call;
  vla_policy* policy = nullptr;
  vla_chunk* chunk = nullptr;
  check_error(nullptr, vla_open(nullptr, nullptr, &policy), VLA_USAGE, "path");
  check_error(nullptr, vla_open("", nullptr, &policy), VLA_USAGE, "path");
  check_error(nullptr, vla_open(call.golden.bundle().c_str(), nullptr, nullptr), VLA_USAGE, "out");
  check_error(nullptr, vla_act(nullptr, &call.observation, &chunk), VLA_USAGE, "policy");
  const PolicyHandle opened = open_policy(call.golden.bundle());
  check_error(opened.get(), vla_act(opened.get(), nullptr, &chunk), VLA_USAGE, "observation");
  check_error(opened.get(), vla_act(opened.get(), &call.observation, nullptr), VLA_USAGE, "out");
  CHECK(vla_describe(nullptr) == nullptr);
  CHECK(vla_chunk_actions(nullptr) == nullptr);
  CHECK(vla_chunk_normalized(nullptr) == nullptr);
  CHECK(vla_chunk_horizon(nullptr) + vla_chunk_d_action(nullptr) == 0);
  CHECK(vla_chunk_n_note(nullptr) + vla_chunk_n_stage(nullptr) == 0);
  CHECK(vla_chunk_note(nullptr, 0) == nullptr);
  CHECK(vla_chunk_stage_name(nullptr, 0) == nullptr);
  CHECK(vla_chunk_stage_ms(nullptr, 0) + vla_chunk_queue_ms(nullptr) == 0);
  vla_policy_close(nullptr);
  vla_chunk_close(nullptr);
}

TEST_CASE("NULL inside an observation is refused by its field") {
  const auto refused = [](auto change, vla_status status, const char* part) {
    Call call;
    change(call);
    check_refused(call, status, part);
  };
  refused([](Call& c) { c.observation.views = nullptr; }, VLA_USAGE, "observation.views");
  refused([](Call& c) { c.observation.states = nullptr; }, VLA_USAGE, "observation.states");
  refused([](Call& c) { c.observation.text = nullptr; }, VLA_USAGE, "observation.text");
  refused([](Call& c) { c.observation.text = nullptr, c.observation.text_size = 0; }, VLA_BAD_OBSERVATION,
          "instruction");
  refused([](Call& c) { c.observation.noise = nullptr; }, VLA_USAGE, "neither");
  refused([](Call& c) { c.views[1].name = nullptr; }, VLA_USAGE, "observation.views[1].name");
  refused([](Call& c) { c.views[1].data = nullptr; }, VLA_USAGE, "camera2");
  refused([](Call& c) { c.states[0].values = nullptr; }, VLA_USAGE, "observation.states[0].values");
}

TEST_CASE("a leftover is taken as a whole or refused by its field") {
  const auto refused = [](auto change, vla_status status, const char* part) {
    Call call;
    change(call.observation);
    check_refused(call, status, part);
  };
  static const float rows[7] = {};
  refused([](vla_observation& o) { o.n_leftover = 7; }, VLA_USAGE, "observation.leftover");
  refused([](vla_observation& o) { o.schedule = "linear"; }, VLA_USAGE, "observation.leftover");
  refused([](vla_observation& o) { o.leftover = rows; }, VLA_BAD_OBSERVATION, "leftover: expected 1 to 5 rows of 7");
  refused([](vla_observation& o) { o.leftover = rows, o.n_leftover = SIZE_MAX; }, VLA_USAGE, "observation.n_leftover");
  refused([](vla_observation& o) { o.leftover = rows, o.n_leftover = 7; }, VLA_BAD_OBSERVATION, "leftover.schedule");
}

TEST_CASE("exactly one of noise and seed must be given") {
  Call call;
  call.observation.has_seed = 1;
  check_refused(call, VLA_USAGE, "expected noise or seed, found both");
  call.use_seed(1);
  call.observation.has_seed = 0;
  check_refused(call, VLA_USAGE, "expected noise or seed, found neither");
  call.observation.has_seed = 2;
  check_refused(call, VLA_USAGE, "has_seed");
  call.observation.has_seed = 1, call.observation.n_noise = 3;
  check_refused(call, VLA_USAGE, "noise");
}

TEST_CASE("images whose size, kind or bytes do not go together are refused by name") {
  const auto refused = [](auto change, vla_status status, const char* part) {
    Call call;
    change(call.views[0]);
    check_refused(call, status, part);
  };
  refused([](vla_view& v) { v.kind = 0; }, VLA_USAGE, "VLA_IMAGE_RGB8");
  refused([](vla_view& v) { v.kind = VLA_IMAGE_ABSENT; }, VLA_USAGE, "no data");
  refused([](vla_view& v) { v.kind = VLA_IMAGE_FILE; }, VLA_USAGE, "camera1");
  refused([](vla_view& v) { v.size -= 1; }, VLA_BAD_OBSERVATION, "camera1");
  refused([](vla_view& v) { v.stride = 1; }, VLA_BAD_OBSERVATION, "stride");
  refused([](vla_view& v) { v.stride = std::numeric_limits<std::size_t>::max() / 2; }, VLA_BAD_OBSERVATION, "stride");
  refused([](vla_view& v) { v.width = -1; }, VLA_BAD_OBSERVATION, "pixels");
  refused([](vla_view& v) { v.width = v.height = std::numeric_limits<std::int32_t>::max(); }, VLA_BAD_OBSERVATION,
          "pixels");
  refused(
      [](vla_view& v) {
        v.kind = VLA_IMAGE_FILE;
        v.width = v.height = 0;
      },
      VLA_BAD_OBSERVATION, "camera1");
  refused([](vla_view& v) { v.name = "camera9"; }, VLA_BAD_OBSERVATION, "camera9");
  refused([](vla_view& v) { v.name = "camera2"; }, VLA_BAD_OBSERVATION, "a second one");
}

TEST_CASE("counts beyond every limit are refused before anything is read or copied") {
  constexpr std::size_t kHuge = std::numeric_limits<std::size_t>::max();
  const auto refused = [](auto change, vla_status status, const char* part) {
    Call call;
    change(call);
    check_refused(call, status, part);
  };
  refused([](Call& c) { c.observation.n_view = kHuge; }, VLA_USAGE, "observation.views");
  refused([](Call& c) { c.observation.n_state = kHuge; }, VLA_USAGE, "observation.states");
  refused([](Call& c) { c.observation.text_size = kHuge; }, VLA_BAD_OBSERVATION, "instruction");
  refused([](Call& c) { c.observation.n_noise = kHuge; }, VLA_BAD_OBSERVATION, "noise");
  refused([](Call& c) { c.states[0].n_value = kHuge; }, VLA_BAD_OBSERVATION, "state");
  const std::string name(100000, 'x');
  refused([&](Call& c) { c.views[0].name = name.c_str(); }, VLA_USAGE, "observation.views[0].name");
}

TEST_CASE("what the engine refuses comes with all its parts") {
  Call call;
  const PolicyHandle policy = open_policy(call.golden.bundle());
  call.states[0].n_value -= 1;
  vla_chunk* chunk = nullptr;
  CHECK(vla_act(policy.get(), &call.observation, &chunk) == VLA_BAD_OBSERVATION);
  const vla_error& error = *vla_last_error(policy.get());
  CHECK(std::string(error.code_name) == "bad_observation");
  CHECK(std::string(error.where) == "observation.state");
  CHECK(std::string(error.expected) == "6 numbers");
  CHECK(std::string(error.found) == "5");
  CHECK(std::string(error.message) == "observation.state: expected 6 numbers, found 5");
}

TEST_CASE("a state far beyond what the policy has seen is answered with a note, or refused where that is asked for") {
  Call call;
  std::vector<float> values(call.states[0].values, call.states[0].values + call.states[0].n_value);
  values.back() = 1e30f;
  call.states[0].values = values.data();
  for (const int strict : {0, 1}) {
    vla_options options = VLA_OPTIONS_INIT;
    options.n_thread = 1;
    options.strict_state = strict;
    vla_policy* opened = nullptr;
    REQUIRE(vla_open(call.golden.bundle().c_str(), &options, &opened) == VLA_OK);
    const PolicyHandle policy(opened);
    vla_chunk* answer = nullptr;
    const vla_status status = vla_act(policy.get(), &call.observation, &answer);
    const ChunkHandle chunk(answer);
    CHECK(status == (strict == 1 ? VLA_BAD_OBSERVATION : VLA_OK));
    CHECK(vla_chunk_n_note(chunk.get()) == (strict == 1 ? 0 : 1));
  }
}

TEST_CASE("a file that cannot be read or is no bundle is a typed error, and options are checked") {
  vla_policy* policy = nullptr;
  check_error(nullptr, vla_open("/nonexistent/policy.gguf", nullptr, &policy), VLA_IO, "/nonexistent/policy.gguf");
  const std::string file = write_file("not_a_bundle.gguf", "not a bundle");
  check_error(nullptr, vla_open(file.c_str(), nullptr, &policy), VLA_BAD_BUNDLE, "not_a_bundle.gguf");
  vla_options options = VLA_OPTIONS_INIT;
  for (const int n_thread : {-1, 513}) {
    options.n_thread = n_thread;
    check_error(nullptr, vla_open(file.c_str(), &options, &policy), VLA_USAGE, "options.n_thread");
  }
  options = VLA_OPTIONS_INIT;
  options.strict_state = 2;
  check_error(nullptr, vla_open(file.c_str(), &options, &policy), VLA_USAGE, "options.strict_state");
  const Call sound;
  options = VLA_OPTIONS_INIT;
  options.kernels = "abacus";
  check_error(nullptr, vla_open(sound.golden.bundle().c_str(), &options, &policy), VLA_USAGE, "abacus");
  options = VLA_OPTIONS_INIT;
  options.memory = 1;
  check_error(nullptr, vla_open(sound.golden.bundle().c_str(), &options, &policy), VLA_OUT_OF_MEMORY, "memory");
  options = VLA_OPTIONS_INIT;
  options.kernels = "ggml";
  REQUIRE(vla_open(sound.golden.bundle().c_str(), &options, &policy) == VLA_OK);
  CHECK(std::string(vla_describe(policy)->kernels) == "ggml");
  vla_policy_close(policy);
}

TEST_CASE("a caller that was compiled with fewer fields works, and one with more is refused only where it uses them") {
  const std::string bundle = kTwoViews + "/bundle.gguf";
  struct {
    vla_options options = VLA_OPTIONS_INIT;
    std::uint64_t later = 0;  // of a version to come
  } newer;
  newer.options.struct_size = sizeof newer;
  vla_policy* policy = nullptr;
  REQUIRE(vla_open(bundle.c_str(), &newer.options, &policy) == VLA_OK);
  vla_policy_close(policy);
  newer.later = 1;
  check_error(nullptr, vla_open(bundle.c_str(), &newer.options, &policy), VLA_UNSUPPORTED, "does not know");

  const std::size_t older = offsetof(vla_options, n_thread);
  CHECK(vla_open(bundle.c_str(), reinterpret_cast<const vla_options*>(&older), &policy) == VLA_OK);
  vla_policy_close(policy);
  for (const std::size_t bad : {std::size_t{0}, std::size_t{7}, std::numeric_limits<std::size_t>::max()}) {
    vla_options options = VLA_OPTIONS_INIT;
    options.struct_size = bad;
    check_error(nullptr, vla_open(bundle.c_str(), &options, &policy), VLA_USAGE, "options.struct_size");
  }
}

TEST_CASE("the views of a caller with larger structs are found where they lie") {
  Call call;
  const PolicyHandle policy = open_policy(call.golden.bundle());
  const std::vector<float> expected = actions_of(policy.get(), call.observation);
  struct Larger {
    vla_view view;
    std::uint64_t later;
  };
  std::vector<Larger> larger;
  for (vla_view& view : call.views) {
    view.struct_size = sizeof(Larger);
    larger.push_back({view, 0});
  }
  call.observation.views = &larger[0].view;
  CHECK(actions_of(policy.get(), call.observation) == expected);
  larger[1].view.struct_size = sizeof(vla_view);
  check_refused(call, VLA_USAGE, "observation.views[1].struct_size");
}

TEST_CASE("an error belongs to its thread and to its policy") {
  const Call call;
  const PolicyHandle policy = open_policy(call.golden.bundle());
  vla_chunk* chunk = nullptr;
  CHECK(vla_act(policy.get(), nullptr, &chunk) == VLA_USAGE);
  std::thread([&] { CHECK(vla_last_error(policy.get())->code == VLA_OK); }).join();
  CHECK(vla_last_error(policy.get())->code == VLA_USAGE);
  CHECK(vla_last_error(nullptr)->code == VLA_OK);
  CHECK(std::string(vla_last_error(nullptr)->code_name) == "ok");
}

}  // namespace refusal_test
