// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "door/floods.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <string>

namespace floods_test {

using namespace vla;
using door::Floods;

namespace {

constexpr char kData = 0, kHeaders = 1, kPriority = 2, kReset = 3, kSettings = 4, kPing = 6, kWindow = 8,
               kContinuation = 9;

std::string frame(char type, std::size_t n_payload, char flags = 0) {
  std::string out = {'\0', static_cast<char>(n_payload >> 8), static_cast<char>(n_payload), type, flags, 0, 0, 0, 1};
  return out + std::string(n_payload, 'x');
}

const std::string kPreface(24, 'P');
const Clock::time_point kStart = Clock::time_point(std::chrono::hours(1));

const char* count(Floods& floods, const std::string& bytes, Clock::time_point now = kStart) {
  return floods.count(std::as_bytes(std::span(bytes)), now);
}

/// How many of these frames a connection may send at once.
int allowance(const std::string& each) {
  Floods floods;
  REQUIRE(count(floods, kPreface) == nullptr);
  for (int n = 0; n < 100'000; ++n)
    if (count(floods, each) != nullptr) return n;
  return 100'000;
}

}  // namespace

TEST_CASE("frames of every kind that carries no call have an allowance") {
  CHECK(allowance(frame(kReset, 4)) == 100);
  CHECK(allowance(frame(kPing, 8)) == 200);
  CHECK(allowance(frame(kSettings, 0)) == 100);
  CHECK(allowance(frame(kSettings, 6, 1)) == 100);
  CHECK(allowance(frame(kContinuation, 0)) == 64);
  CHECK(allowance(frame(kData, 0)) == 200);
  CHECK(allowance(frame(kData, 1)) == 2000);
  CHECK(allowance(frame(kWindow, 4)) == 2000);
  CHECK(allowance(frame(kPriority, 5)) == 100);
  CHECK(allowance(frame(77, 5)) == 100);
  CHECK(allowance(frame(5, 4)) == 0);  // PUSH_PROMISE, which no client may send
}

TEST_CASE("frames that carry something are not counted, nor those that end a call") {
  CHECK(allowance(frame(kData, 16000)) == 100'000);
  CHECK(allowance(frame(kData, 0, 1)) == 100'000);
}

TEST_CASE("an allowance fills up again with time, to its size") {
  Floods floods;
  count(floods, kPreface);
  const auto spend_all = [&](Clock::time_point now) {
    int n = 0;
    while (count(floods, frame(kReset, 0), now) == nullptr) ++n;
    return n;
  };
  CHECK(spend_all(kStart) == 100);
  CHECK(spend_all(kStart + std::chrono::seconds(2)) == 40);
  CHECK(spend_all(kStart + std::chrono::hours(2)) == 100);
}

TEST_CASE("the headers of a call are bounded over all of their frames") {
  Floods floods;
  count(floods, kPreface);
  CHECK(count(floods, frame(kHeaders, 10'000)) == nullptr);
  CHECK(count(floods, frame(kContinuation, 6'000)) == nullptr);
  CHECK(count(floods, frame(kContinuation, 1'000)) != nullptr);
  Floods others;
  count(others, kPreface);
  for (int i = 0; i < 60; ++i) CHECK(count(others, frame(kHeaders, 10'000, 4)) == nullptr);
}

TEST_CASE("frames are found wherever the bytes are cut") {
  std::string bytes = kPreface;
  for (int i = 0; i < 101; ++i) bytes += frame(kReset, 4) + frame(kData, 300);
  for (const std::size_t piece : {1, 7, 24, 1000, 100'000}) {
    Floods floods;
    const char* found = nullptr;
    std::size_t at = 0;
    for (; at < bytes.size() && found == nullptr; at += piece) found = count(floods, bytes.substr(at, piece));
    CHECK(std::string(found == nullptr ? "" : found) == "RST_STREAM");
    CHECK(at + 400 + piece > bytes.size());  // the last of them
  }
}

}  // namespace floods_test
