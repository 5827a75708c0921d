// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Requests that fuzzing found, and those that it starts from, through the same checks as in the fuzz target.
#include <doctest/doctest.h>

#include <filesystem>

#include "fuzz/request_target.h"
#include "support/editable_bundle.h"

using namespace vla;
using namespace vla::test;

namespace {

const std::string kFolder = source_path("tests/fuzz/regressions/request");

fuzz::RequestFate fate(const std::string& bytes) { return fuzz::check_request(std::as_bytes(std::span(bytes))); }

}  // namespace

TEST_CASE("requests from fuzzing are read within the limits or refused") {
  int count = 0;
  for (const auto& entry : std::filesystem::directory_iterator(kFolder)) {
    (void)fate(read_text(entry.path())).sound;
    ++count;
  }
  CHECK(count >= 4);
}

TEST_CASE("the requests that fuzzing starts from reach every decoder") {
  CHECK(fate(read_text(kFolder + "/act")).sound);
  CHECK(fate(read_text(kFolder + "/act")).kind == serve::Kind::act);
  CHECK(fate(read_text(kFolder + "/hello")).sound);
  CHECK(fate(read_text(kFolder + "/describe")).sound);
  CHECK(fate(read_text(kFolder + "/health")).sound);
}
