// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Requests that fuzzing found, and those that it starts from, through the same checks as in the fuzz target.
#include <doctest/doctest.h>

#include <filesystem>

#include "fuzz/file_target.h"
#include "fuzz/mutate.h"
#include "fuzz/request_target.h"
#include "fuzz/session_target.h"
#include "support/editable_bundle.h"

namespace regressions_test {

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
  CHECK(fate(read_text(kFolder + "/act")).kind == wire::Kind::act);
  CHECK(fate(read_text(kFolder + "/hello")).sound);
  CHECK(fate(read_text(kFolder + "/describe")).sound);
  CHECK(fate(read_text(kFolder + "/health")).sound);
}

TEST_CASE(
    "sessions from fuzzing get through the handshake, with keys and without, and damaged ones end with a reason") {
  fuzz::Random random(1);
  for (const auto& [name, n_message] : {std::pair{"plain", 4}, {"keys", 3}}) {
    CAPTURE(name);
    const std::string sound = read_text(source_path("tests/fuzz/regressions/session/") + name);
    CHECK(fuzz::check_session(sound) == n_message);
    for (int round = 0; round < 1000; ++round) (void)fuzz::check_session(fuzz::damaged(sound, random));
  }
}

TEST_CASE("the files that fuzzing starts from are read whole") {
  for (const auto& [name, kind] : {std::pair{"recording", fuzz::FileKind::recording},
                                   {"taps", fuzz::FileKind::taps},
                                   {"keys", fuzz::FileKind::keys}}) {
    CAPTURE(name);
    const std::string bytes = read_text(source_path("tests/fuzz/regressions/file/") + name);
    REQUIRE(bytes.front() == static_cast<char>(kind));  // as the fuzz target reads them
    CHECK(fuzz::check_file(kind, bytes.substr(1), scratch_path("fuzz_files")));
  }
}

TEST_CASE("damaged recordings, taps and key files are read or refused, in bounded time and memory") {
  const std::string folder = scratch_path("odd_files");
  std::filesystem::remove_all(folder);
  {
    const auto recorder = observe::Recorder::open(folder, 1 << 20);
    REQUIRE(recorder.ok());
    (*recorder)->describe({});
    const std::string act = read_text(kFolder + "/act"), answer = "an answer";
    for (int i = 0; i < 3; ++i) {
      observe::Answered answered;
      answered.request.kind = wire::Kind::act;
      answered.in = std::as_bytes(std::span(act));
      answered.out = std::as_bytes(std::span(answer));
      (*recorder)->answered(answered);
    }
  }
  const std::string recording = read_text(folder + "/" + observe::kRecordingFile);
  const std::string taps = folder + "/taps";
  REQUIRE(write_taps({{"a", {2, 3}, {1, 2, 3, 4, 5, 6}}, {"b", {1}, {7}}}, taps).ok());
  const std::string key = "rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7";
  const std::pair<fuzz::FileKind, std::string> sound[] = {
      {fuzz::FileKind::recording, recording},
      {fuzz::FileKind::taps, read_text(taps)},
      {fuzz::FileKind::keys, "# robots\n" + key + " arm\n" + key + "\n"}};
  fuzz::Random random(1);
  for (const auto& [kind, bytes] : sound) {
    CAPTURE(static_cast<int>(kind));
    CHECK(fuzz::check_file(kind, bytes, folder));
    for (int round = 0; round < 300; ++round) (void)fuzz::check_file(kind, fuzz::damaged(bytes, random), folder);
  }
}

}  // namespace regressions_test
