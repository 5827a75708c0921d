// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// What a C program gets: through libvla.so alone, compared with the engine.
#include <atomic>
#include <cstring>
#include <thread>

#include "capi/policy.h"
#include "support/editable_bundle.h"

namespace act_test {

using namespace vla;
using namespace vla::test;

TEST_CASE("the library's version of the binary interface is that of the header") {
  CHECK(vla_abi_version() == VLA_ABI_VERSION);
  CHECK(std::string(vla_version()).find('.') != std::string::npos);
}

TEST_CASE("every golden case gives the engine's bytes through the C interface, from noise and from a seed") {
  for (const std::string& path : some_of(golden_paths())) {
    CAPTURE(path);
    Call call(path);
    const PolicyHandle policy = open_policy(call.golden.bundle());
    const auto engine = load_engine(call.golden.bundle());
    CHECK(actions_of(policy.get(), call.observation) ==
          engine->act(call.golden.observation, call.golden.noise)->actions);
    call.use_seed(11);
    CHECK(actions_of(policy.get(), call.observation) ==
          engine->act(call.golden.observation, std::uint64_t{11})->actions);
  }
}

TEST_CASE("rows with gaps between them, rows without, and the PNG file that holds them are the same frame") {
  Call call;
  const PolicyHandle policy = open_policy(call.golden.bundle());
  const std::vector<float> expected = actions_of(policy.get(), call.observation);
  vla_view& view = call.views[0];
  const auto row = static_cast<std::size_t>(view.width) * 3, height = static_cast<std::size_t>(view.height);

  std::vector<std::uint8_t> wide(height * (row + 5), 0xAA);
  for (std::size_t i = 0; i < height; ++i)
    std::memcpy(&wide[i * (row + 5)], static_cast<const std::uint8_t*>(view.data) + i * row, row);
  view.stride = row + 5;
  view.data = wide.data(), view.size = wide.size();
  CHECK(actions_of(policy.get(), call.observation) == expected);
  view.size -= 5;  // the end of a crop of a larger image
  CHECK(actions_of(policy.get(), call.observation) == expected);

  const std::string file = read_text(call.golden.path + "/" + view.name + ".png");
  const char* name = view.name;
  view = VLA_VIEW_INIT;
  view.name = name;
  view.kind = VLA_IMAGE_FILE, view.data = file.data(), view.size = file.size();
  CHECK(actions_of(policy.get(), call.observation) == expected);
}

TEST_CASE("a state without a name is the only state") {
  Call call;
  const PolicyHandle policy = open_policy(call.golden.bundle());
  const std::vector<float> expected = actions_of(policy.get(), call.observation);
  call.states[0].name = nullptr;
  CHECK(actions_of(policy.get(), call.observation) == expected);
}

TEST_CASE("a description tells what the bundle says") {
  const Call call;
  const PolicyHandle policy = open_policy(call.golden.bundle());
  const vla_description& d = *vla_describe(policy.get());
  CHECK(d.struct_size == sizeof d);
  REQUIRE(d.n_view == 2);
  CHECK(d.min_views == 1);
  CHECK(std::string(d.views[0]->name) == "observation.images.camera1");
  CHECK(d.views[1]->width > 0);
  REQUIRE(d.n_state == 1);
  CHECK(d.states[0]->width == call.golden.observation.states.begin()->second.size());
  CHECK(std::string(d.states[0]->number_names[0]) != "");
  CHECK(std::string(d.states[0]->units[d.states[0]->width - 1]) == "");
  CHECK(d.noise_rows * d.d_noise == call.golden.noise.size());
  CHECK(d.d_action == 7);
  CHECK(std::string(d.action_names[6]) == "action.6");
  CHECK(std::string(d.action_units[6]) == "");
  CHECK(std::string(d.noise) == "normal");
  CHECK(std::string(d.arch) == "smolvla");
  CHECK(std::string(d.dtype) == "bf16");
  CHECK(std::string(d.checksum).rfind("xxh3:", 0) == 0);
  CHECK(d.bundle_path == call.golden.bundle());
  CHECK(d.memory_weights > 0);
  CHECK(d.memory_working > 0);
}

TEST_CASE("a chunk outlives its policy and has notes and stages, and nothing beyond the last of them") {
  Call call(golden_path("smolvla/long_text"));
  PolicyHandle policy = open_policy(call.golden.bundle());
  vla_chunk* made = nullptr;
  REQUIRE(vla_act(policy.get(), &call.observation, &made) == VLA_OK);
  policy.reset();
  const ChunkHandle chunk(made);
  CHECK(vla_chunk_actions(chunk.get()) != nullptr);
  REQUIRE(vla_chunk_n_note(chunk.get()) == 1);
  CHECK(std::string(vla_chunk_note(chunk.get(), 0)).find("cut") != std::string::npos);
  CHECK(vla_chunk_note(chunk.get(), 1) == nullptr);
  std::string stages;
  for (std::size_t i = 0; i < vla_chunk_n_stage(chunk.get()); ++i) {
    stages += std::string(vla_chunk_stage_name(chunk.get(), i)) + " ";
    CHECK(vla_chunk_stage_ms(chunk.get(), i) >= 0);
  }
  std::string expected = "decode ";
  const auto answer = load_engine(call.golden.bundle())->act(call.golden.observation, call.golden.noise);
  for (const auto& [stage, ms] : answer->timing) expected += stage + " ";
  CHECK(stages == expected);
  CHECK(vla_chunk_stage_name(chunk.get(), 99) == nullptr);
  CHECK(vla_chunk_queue_ms(chunk.get()) >= 0);
}

TEST_CASE("threads that share a policy get the answers that each would get alone") {
  constexpr std::uint64_t kThread = 6;
  const Call reference;
  const PolicyHandle policy = open_policy(reference.golden.bundle());
  std::vector<std::vector<float>> alone;
  for (std::uint64_t seed = 0; seed < kThread; ++seed) {
    Call call;
    call.use_seed(seed);
    alone.push_back(actions_of(policy.get(), call.observation));
  }
  std::atomic<int> n_same = 0;
  std::vector<std::thread> threads;
  for (std::uint64_t seed = 0; seed < kThread; ++seed)
    threads.emplace_back([&, seed] {
      Call call;
      call.use_seed(seed);
      for (int i = 0; i < 4; ++i) {
        vla_chunk* chunk = nullptr;
        if (vla_act(policy.get(), &call.observation, &chunk) != VLA_OK) continue;
        const ChunkHandle handle(chunk);
        n_same += std::memcmp(vla_chunk_actions(chunk), alone[seed].data(), alone[seed].size() * sizeof(float)) == 0;
      }
    });
  for (std::thread& thread : threads) thread.join();
  CHECK(n_same == 4 * static_cast<int>(kThread));
}

TEST_CASE("policies are opened and act at the same time without touching each other") {
  const std::vector<std::string> paths = some_of(golden_paths());
  std::vector<std::vector<float>> alone;
  for (const std::string& path : paths) {
    const Call call(path);
    alone.push_back(actions_of(open_policy(call.golden.bundle()).get(), call.observation));
  }
  std::atomic<int> n_same = 0;
  std::vector<std::thread> threads;
  for (std::size_t i = 0; i < paths.size(); ++i)
    threads.emplace_back([&, i] {
      const Call call(paths[i]);
      for (int repeat = 0; repeat < 3; ++repeat)
        n_same += actions_of(open_policy(call.golden.bundle()).get(), call.observation) == alone[i];
    });
  for (std::thread& thread : threads) thread.join();
  CHECK(n_same == 3 * static_cast<int>(paths.size()));
}

}  // namespace act_test
