// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// What the live page holds, and what it makes of acts that a robot would not send.
#include "observe/page.h"

#include <arpa/inet.h>
#include <sys/socket.h>
#include <unistd.h>

#include <array>
#include <nlohmann/json.hpp>

#include "base/process.h"
#include "serve/support.h"
#include "support/connect_http.h"

namespace page_test {

using namespace vla;
using namespace vla::test;
using namespace vla::observe;
using namespace vla::serve;
using nlohmann::json;

namespace {

struct Watched {
  std::unique_ptr<Page> page;
  std::string out;

  Watched() {
    auto opened = Page::open("127.0.0.1:0", false,
                             {.token = "t",
                              .is_same = [](std::string_view a, std::string_view b) { return a == b; },
                              .health = [] { return Health(); }});
    REQUIRE(opened.ok());
    page = std::move(*opened);
    v1::Response response;
    response.mutable_error()->set_where("act");
    out = response.SerializeAsString();
  }

  void refused(const std::string& in) const {
    const Error error{Code::bad_request, "act", "another", "this"};
    Received request{.client = "1", .peer = "10.0.0.7", .name = "arm", .kind = Kind::act, .at = Clock::now()};
    page->answered({.request = request,
                    .error = &error,
                    .sent = request.at,
                    .in = std::as_bytes(std::span(in)),
                    .out = std::as_bytes(std::span(out))});
  }

  /// The body of an answer; how long it took, in seconds.
  std::string get(const std::string& path, double& seconds) const {
    const auto begun = Clock::now();
    const int fd = test::connect_http(page->address());
    const std::string asked = "GET " + path + "&token=t HTTP/1.1\r\nHost: x\r\n\r\n";
    REQUIRE(::send(fd, asked.data(), asked.size(), MSG_NOSIGNAL) == static_cast<ssize_t>(asked.size()));
    std::string answer;
    std::array<char, 1 << 16> part;
    for (ssize_t n; (n = ::read(fd, part.data(), part.size())) > 0;)
      answer.append(part.data(), static_cast<std::size_t>(n));
    ::close(fd);
    seconds = std::chrono::duration<double>(Clock::now() - begun).count();
    return answer.substr(answer.find("\r\n\r\n") + 4);
  }
  json acts() const {
    double seconds = 0;
    return json::parse(get("/acts?after=0", seconds));
  }
};

std::string varint(std::size_t n) {
  std::string out;
  for (; n > 127; n >>= 7) out += static_cast<char>((n & 127) | 128);
  return out + static_cast<char>(n);
}

std::string field(int number, const std::string& bytes) {
  return varint(static_cast<std::size_t>(number) << 3 | 2) + varint(bytes.size()) + bytes;
}

std::string repeated(const std::string& bytes, std::size_t count) {
  std::string all;
  all.reserve(bytes.size() * count);
  for (std::size_t i = 0; i < count; ++i) all += bytes;
  return all;
}

/// A request that holds these fields of an act.
std::string request_with(const std::string& act) { return std::string("\x08\x01", 2) + field(5, act); }

constexpr std::size_t kSize = 30 << 20;
constexpr int kViews = 1, kStates = 2, kText = 3, kLoop = 11;

}  // namespace

TEST_CASE("small acts count with all that they take, so that any number of them stays within the page's memory") {
  const Watched watched;
  [[maybe_unused]] const std::size_t before = resident_size();
  const std::string act = request_with("");
  for (int i = 0; i < 700'000; ++i) watched.refused(act);
  const json told = watched.acts();
  CHECK(told["last"] == 700'000);
  CHECK(told["first"] > 1);                                          // the oldest have gone
#if !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)  // which keep what is freed
  CHECK(resident_size() - before < Page::kMaxBytes * 5 / 4);
#endif
}

TEST_CASE("a refused act of 30 MB, whatever it is made of, is told at once and in few bytes") {
  const std::string values = field(2, std::string(kSize, '?'));
  const std::string hostile[] = {
      field(kText, std::string(kSize, 'x')),
      field(kText, std::string(kSize, '\x01')),
      field(kStates, field(1, "arm") + values),
      field(kStates, field(1, std::string(kSize, 'n'))),
      field(kStates, repeated(std::string("\x15\0\0\x80?", 5), kSize / 5)),  // a value a field
      repeated(field(kStates, field(1, "a")), kSize / 5),
      repeated(field(kLoop, "\x08\x02"), kSize / 4),
      repeated(field(kLoop, std::string(60'000, '\x08')), kSize / 60'000),
      repeated(field(kViews, ""), kSize / 2),
      field(kViews, field(1, "top") + repeated("\x78\x01", kSize / 2)),
      field(kViews, field(1, "top") + field(2,
                                            "\x08\xff\xff\xff\xff\x0f\x10\x01\x1a\x03"
                                            "abc")),
      field(kViews, field(1, std::string(kSize, 'v')) + field(3, "no jpeg")),
      repeated("\x78\x01", kSize / 2),
      std::string(kSize, '\xff'),
  };
  for (std::size_t i = 0; i < std::size(hostile); ++i) {
    CAPTURE(i);
    const Watched watched;
    watched.refused(request_with(hostile[i]));
    watched.refused(request_with(field(kText, "after it")));
    double seconds = 0;
    const std::string told = watched.get("/acts?after=0", seconds);
    CHECK(seconds < 2);
    CHECK(told.size() < 100'000);
    const json acts = json::parse(told)["acts"];
    REQUIRE(acts.size() == 2);
    CHECK(acts[1]["text"] == "after it");
    watched.get("/image?act=1&view=0", seconds);
    CHECK(seconds < 2);
    watched.get("/image?act=1&view=0&as=seen", seconds);
    CHECK(seconds < 2);
  }
}

TEST_CASE("the state of a loop is told as the act has it, and nothing where it is none") {
  const Watched watched;
  watched.refused(request_with(""));
  watched.refused(request_with(field(kLoop, "\x08\x02\x10\x07\x38\x01")));
  watched.refused(request_with(field(kLoop, "\x08\x09")));
  watched.refused(request_with(field(kLoop, "\x08")));
  const json acts = watched.acts()["acts"];
  CHECK_FALSE(acts[0].contains("loop"));
  CHECK(acts[1]["loop"] == json::parse(R"({"driver": "PERSON", "actions": 7, "human": 0, "held": 0, "missed": 0,
                                           "limited": 0, "refused": 1})"));
  CHECK(acts[2]["loop"]["driver"] == "");
  CHECK(acts[3]["loop"].is_null());
}

TEST_CASE("texts, names and states are told up to a size, and pixels where they are those of their sides") {
  const Watched watched;
  v1::Request request;
  request.set_protocol_version(1);
  v1::Act& act = *request.mutable_act();
  act.set_text(std::string(5000, 'x'));
  for (int i = 0; i < 40; ++i) {
    v1::State& state = *act.add_states();
    state.set_name("state." + std::to_string(i));
    for (int k = 0; k < 100; ++k) state.add_values(0.5f);
    v1::View& view = *act.add_views();
    view.set_name(std::string(300, 'v') + std::to_string(i));
    view.mutable_rgb()->set_width(2);
    view.mutable_rgb()->set_height(i == 0 ? 1 : 7);
    view.mutable_rgb()->set_rows("abcdef");
  }
  watched.refused(request.SerializeAsString());
  const json told = watched.acts()["acts"][0];
  CHECK(told["text"] == std::string(4096, 'x') + "...");
  CHECK(told["views"].size() == 32);
  CHECK(told["views"][0]["name"] == std::string(256, 'v') + "...");
  CHECK(told["states"].size() == 32);
  CHECK(told["states"]["state.0"].size() == 100);
  std::size_t n_value = 0;
  for (const json& values : told["states"]) n_value += values.size();
  CHECK(n_value == 1024);
  double seconds = 0;
  CHECK(watched.get("/image?act=1&view=0", seconds) == "P6 2 1 255\nabcdef");
  CHECK(watched.get("/image?act=1&view=1", seconds) == "pixels of other sides\n");
  CHECK(watched.get("/image?act=1&view=40", seconds) == "gone, or never there\n");
}

}  // namespace page_test
