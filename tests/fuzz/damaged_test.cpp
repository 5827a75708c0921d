// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// A fuzz target without a fuzzer, for every compiler: what it starts from, and damage done to that, for some seconds.
#include <doctest/doctest.h>

#include <cerrno>
#include <chrono>
#include <filesystem>

#include "bundle/bundle.h"
#include "fuzz/mutate.h"
#include "support/editable_bundle.h"

using namespace vla;
using namespace vla::test;

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size);
extern "C" [[gnu::weak]] std::size_t LLVMFuzzerCustomMutator(std::uint8_t* data, std::size_t size, std::size_t max_size,
                                                             unsigned seed);

namespace {

constexpr std::chrono::seconds kTime{5};

void check(const std::string& bytes) {
  LLVMFuzzerTestOneInput(reinterpret_cast<const std::uint8_t*>(bytes.data()), bytes.size());
}

std::string mutant(std::string bytes, fuzz::Random& random) {
  if (LLVMFuzzerCustomMutator == nullptr) return fuzz::damaged(std::move(bytes), random);
  const std::size_t size = bytes.size();
  bytes.resize(2 * size);
  bytes.resize(LLVMFuzzerCustomMutator(reinterpret_cast<std::uint8_t*>(bytes.data()), size, bytes.size(),
                                       static_cast<unsigned>(random())));
  return bytes;
}

/// What scripts/fuzz.sh starts from too.
std::vector<std::string> seeds(const std::string& target) {
  std::vector<std::string> files, out, folders{source_path("tests/fuzz/regressions/" + target)};
  if (target == "image") folders.push_back(source_path("tests/processor/data/images"));
  for (const std::string& folder : folders)
    if (std::filesystem::is_directory(folder))
      for (const auto& entry : std::filesystem::directory_iterator(folder)) files.push_back(entry.path());
  std::sort(files.begin(), files.end());
  if (target == "act") files = golden_bundles();
  for (const std::string& file : files) out.push_back(read_text(file));
  if (target == "recipe")
    for (const std::string& bundle : golden_bundles())
      out.push_back(*EditableBundle::read(bundle).keys.string("processor.recipe"));
  return out;
}

}  // namespace

TEST_CASE("damaged seeds of a fuzz target keep its check") {
  const std::string program = program_invocation_short_name;  // <target>_fuzz
  const std::vector<std::string> sound = seeds(program.substr(0, program.rfind("_fuzz")));
  REQUIRE(!sound.empty());
  for (const std::string& seed : sound) check(seed);
  const auto end = std::chrono::steady_clock::now() + kTime;
  fuzz::Random random(1);
  int n_input = 0;
  for (; std::chrono::steady_clock::now() < end; ++n_input)
    check(mutant(sound[fuzz::below(random, sound.size())], random));
  MESSAGE(n_input << " inputs");
  CHECK(n_input > 0);
}
