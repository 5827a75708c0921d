// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Inputs that fuzzing found, or that are worth starting from, through the same checks as in the fuzz targets.
#include <filesystem>

#include "fuzz/image_target.h"
#include "fuzz/tokenizer_target.h"
#include "processor/support.h"

namespace regressions_test {

using namespace vla;
using namespace vla::test;

namespace {

template <class Check>
int replay(const std::string& folder, Check check) {
  int count = 0;
  for (const auto& entry : std::filesystem::directory_iterator(source_path(folder))) {
    const std::string bytes = read_text(entry.path());
    check(bytes);
    ++count;
  }
  return count;
}

}  // namespace

TEST_CASE("images from fuzzing decode to sound frames or are refused") {
  CHECK(replay("tests/fuzz/regressions/image", [](const std::string& bytes) { fuzz::check_image(bytes_of(bytes)); }) >
        0);
}

TEST_CASE("texts and JSON from fuzzing are encoded or refused") {
  CHECK(replay("tests/fuzz/regressions/tokenizer", [](const std::string& bytes) { fuzz::check_tokenizer(bytes); }) > 0);
}

}  // namespace regressions_test
