// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Bundles that fuzzing found, and the one that it starts from, through the same checks as in the fuzz target.
#include <doctest/doctest.h>

#include <filesystem>

#include "fuzz/bundle_target.h"
#include "support/joint_bundle.h"

namespace bundle_regressions_test {

using namespace vla;
using namespace vla::test;
using fuzz::Depth;

namespace {

const std::string kFolder = source_path("tests/fuzz/regressions/bundle");

Depth depth(const std::string& bytes) { return fuzz::check_bundle(std::as_bytes(std::span(bytes))); }

/// A golden bundle with every size as small as the architecture allows: a fuzzer reads little and changes much.
EditableBundle smallest_bundle() {
  EditableBundle bundle = EditableBundle::read(golden_path("smolvla/absent_view/bundle.gguf"));
  for (const char* key : {"vision.d_model", "vision.d_ff", "vision.image_size", "lm.d_model", "lm.d_head", "lm.d_ff",
                          "expert.d_model", "expert.d_ff", "connector.factor"})
    bundle.set(key, Value(std::int64_t{2}));
  for (const char* key : {"vision.n_head", "vision.patch_size", "lm.n_head", "lm.n_head_kv"})
    bundle.set(key, Value(std::int64_t{1}));
  std::erase_if(bundle.tensors, [](const auto& piece) { return !piece.name.starts_with("stats."); });
  ParamList manifest(bundle.keys, nullptr);
  const auto policy = find_policy("smolvla")->make(manifest);
  for (const Param& param : manifest.params()) {
    const auto size = static_cast<std::size_t>(param.count()) * sizeof(float);
    bundle.tensors.push_back({param.name, DType::f32, param.shape, std::string(size, '\0')});
  }
  return bundle;
}

/// The same for two robots, each with its own recipe and statistics.
EditableBundle smallest_of_two() {
  return joint_bundle({{"arm", smallest_bundle()}, {"dog", smallest_bundle()}}, is_robots_own);
}

}  // namespace

TEST_CASE("the fuzz target follows a golden bundle through every check before memory is taken") {
  std::string bytes = read_text(golden_path("smolvla/two_views/bundle.gguf"));
  CHECK(depth(bytes) == Depth::declared);
  bytes.back() = static_cast<char>(bytes.back() ^ 1);  // a damaged weight, whose checksum the target makes fit
  CHECK(depth(bytes) == Depth::declared);
  CHECK(depth(bytes.substr(0, bytes.size() / 2)) == Depth::refused);
}

TEST_CASE("the bundles that fuzzing starts from are whole") {
  for (const auto& [name, bundle] :
       {std::pair("smallest", smallest_bundle()), {"smallest_of_two", smallest_of_two()}}) {
    const std::string bytes = bundle.bytes();
    CHECK(depth(bytes) == Depth::declared);
    CHECK(bytes.size() < 20000);  // what scripts/fuzz.sh lets a fuzzer read
    CHECK_MESSAGE(read_text(kFolder + "/" + name) == bytes,
                  "the layout of bundles changed: copy " << write_file(name, bytes) << " to " << kFolder);
  }
}

TEST_CASE("the fuzz target loads every robot of a bundle") {
  EditableBundle bundle = smallest_of_two();
  bundle.remove_key("embodiment.dog.processor.recipe");
  CHECK(depth(bundle.bytes()) == Depth::parsed);
}

TEST_CASE("bundles from fuzzing load or are refused") {
  int count = 0;
  for (const auto& entry : std::filesystem::directory_iterator(kFolder)) {
    depth(read_text(entry.path()));
    ++count;
  }
  CHECK(count > 0);
}

}  // namespace bundle_regressions_test
