// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/seen_sizes.h"

#include <unistd.h>

#include <filesystem>
#include <fstream>

#include "serve/support.h"
#include "serve/warm_up.h"

namespace seen_sizes_test {

using namespace vla;
using namespace vla::test;
using serve::SeenSizes;

namespace {

/// A file that is gone after the test.
struct File {
  File() : path("/tmp/vla-sizes-" + std::to_string(getpid())) { std::filesystem::remove(path); }
  ~File() { std::filesystem::remove(path); }
  std::string path;
};

std::unique_ptr<SeenSizes> open(const std::string& path, std::function<void(const Error&)> tell = {}) {
  auto sizes = SeenSizes::open(path, std::move(tell));
  REQUIRE_MESSAGE(sizes.ok(), (sizes ? "" : sizes.error().message()));
  return std::move(*sizes);
}

void act(Engine& engine, const std::string& text) {
  Observation observation = golden().observation;
  observation.text = text;
  REQUIRE(engine.act(observation, std::uint64_t{1}).ok());
}

}  // namespace

TEST_CASE("the sizes of acts that a server answered are there when the next one starts, each once") {
  const File file;
  const auto sizes = open(file.path);
  {
    Running running({}, {}, nullptr, sizes.get());
    Peer peer(running.address());
    v1::Request request = act_request(golden(), 1);
    for (const char* text : {"go", "to", "put the cube into the basket"}) {
      request.mutable_act()->set_text(text);
      REQUIRE(peer.ask(request).has_chunk());
    }
    request.mutable_act()->clear_states();
    REQUIRE(peer.ask(request).has_error());
  }
  const auto engine = load_engine(kGolden + "/bundle.gguf");
  const std::vector<ActShape> seen = open(file.path)->of(*engine);
  REQUIRE(seen.size() == 2);
  CHECK(seen == sizes->of(*engine));
  CHECK(seen[0].inputs.n_text < seen[1].inputs.n_text);

  const std::size_t largest = engine->memory().plan;
  REQUIRE(serve::warm_up(*engine, seen).ok());
  const std::size_t warm = engine->memory().plan;
  CHECK(warm > largest);
  act(*engine, "go");
  act(*engine, "put the cube into the basket");
  CHECK(engine->memory().plan == warm);
}

TEST_CASE("sizes of another bundle are left out, and those that an observation cannot have are passed over") {
  const File file;
  std::ofstream(file.path)
      << R"([{"bundle": "bundle.gguf", "embodiment": "", "width": 1, "height": 1, "views": 1, "tokens": 99999,
    "state": 1, "which_views": 0, "continues": false}, {"bundle": "other.gguf", "embodiment": "", "width": 1, "height": 1, "views": 1,
    "tokens": 1, "state": 1, "which_views": 0, "continues": false}])";
  const auto engine = load_engine(kGolden + "/bundle.gguf");
  const std::vector<ActShape> seen = open(file.path)->of(*engine);
  REQUIRE(seen.size() == 1);
  CHECK(serve::warm_up(*engine, seen).ok());
}

TEST_CASE("sentences of a text are kept, and those that no text has are passed over") {
  const File file;
  const std::string folder = golden_path("turbovla_authors/two_views");
  const auto engine = load_engine(folder + "/bundle.gguf");
  REQUIRE(engine->act(GoldenCase::read(folder).observation, std::uint64_t{1}).ok());
  open(file.path)->add(*engine);
  const std::vector<ActShape> kept = open(file.path)->of(*engine);
  REQUIRE(kept.size() == 1);
  CHECK(kept.front() == *engine->last_shape());
  CHECK(kept.front().inputs.text.sentences.size() > 1);
  ActShape odd = kept.front();
  odd.inputs.text.sentences.push_back(1);
  CHECK(engine->warm_up(odd).error().code == Code::bad_observation);
  CHECK(serve::warm_up(*engine, {odd}).ok());
}

TEST_CASE("a file that holds no sizes is refused with what to do") {
  const File file;
  for (const char* text : {"", "{", "[1]", R"([{"bundle": 3}])", "[{}]"}) {
    std::ofstream(file.path) << text;
    const auto sizes = SeenSizes::open(file.path, {});
    REQUIRE(!sizes.ok());
    CHECK(sizes.error().code == Code::usage);
    CHECK(sizes.error().hint == "remove the file or name another one");
  }
}

TEST_CASE("a file that cannot be written is told once, and acts go on") {
  int n_told = 0;
  const auto sizes = open("/absent/folder/sizes", [&](const Error& error) {
    ++n_told;
    CHECK(error.message().find("/absent/folder/sizes") != std::string::npos);
  });
  const auto engine = load_engine(kGolden + "/bundle.gguf");
  for (const char* text : {"go", "put the cube into the basket"}) {
    act(*engine, text);
    sizes->add(*engine);
  }
  CHECK(n_told == 1);
  CHECK(sizes->of(*engine).size() == 2);
}

TEST_CASE("the newest sizes are kept") {
  const File file;
  std::string text;
  for (int n = 1; n <= static_cast<int>(SeenSizes::kMost); ++n)
    text +=
        (text.empty() ? "[" : ",") +
        std::string(R"({"bundle": "bundle.gguf", "embodiment": "", "width": 1, "height": 1, "views": 1, "tokens": )") +
        std::to_string(n) + R"(, "state": 1, "which_views": 0, "continues": false})";
  std::ofstream(file.path) << text << "]";
  const auto engine = load_engine(kGolden + "/bundle.gguf");
  const auto sizes = open(file.path);
  CHECK(sizes->of(*engine).size() == SeenSizes::kMost);
  act(*engine, "go");
  sizes->add(*engine);
  const std::vector<ActShape> kept = open(file.path)->of(*engine);
  CHECK(kept.size() == SeenSizes::kMost);
  CHECK(kept.front().inputs.n_text == 2);
  CHECK(kept.back() == *engine->last_shape());
}

}  // namespace seen_sizes_test
