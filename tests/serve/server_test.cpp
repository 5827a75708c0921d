// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// What the server answers to one client, and to bytes that no client should send.
#include "serve/server.h"

#include <cmath>
#include <cstring>
#include <random>

#include "serve/support.h"
#include "serve/warm_up.h"

namespace server_test {

using namespace vla;
using namespace vla::test;

TEST_CASE("an act through the server gives the bytes that the engine gives, from noise and from a seed") {
  Running running;
  Peer peer(running.address());
  const auto engine = load_engine(kGolden + "/bundle.gguf");
  v1::Request request = act_request(golden(), 1);
  for (const Noise& noise : {Noise(golden().noise), Noise(std::uint64_t{99})}) {
    if (const auto* values = std::get_if<std::vector<float>>(&noise)) {
      v1::Noise& sent = *request.mutable_act()->mutable_noise();
      sent.set_horizon(static_cast<std::uint32_t>(engine->robot().solver_horizon()));
      sent.set_d_action(static_cast<std::uint32_t>(engine->robot().d_action_padded()));
      sent.mutable_values()->Add(values->begin(), values->end());
    } else {
      request.mutable_act()->set_seed(std::get<std::uint64_t>(noise));
    }
    request.mutable_act()->set_capture_time_ns(123);
    const auto expected = engine->act(golden().observation, noise);
    REQUIRE(expected.ok());
    const v1::Response response = peer.ask(request);
    REQUIRE_MESSAGE(response.has_chunk(), response.error().found());
    const v1::ActionChunk& chunk = response.chunk();
    CHECK(std::vector<float>(chunk.actions().begin(), chunk.actions().end()) == expected->actions);
    CHECK(chunk.horizon() * chunk.d_action() == expected->actions.size());
    CHECK(static_cast<std::uint32_t>(chunk.names_size()) == chunk.d_action());
    CHECK(chunk.has_seed() == std::holds_alternative<std::uint64_t>(noise));
    CHECK(chunk.capture_time_ns() == 123);
    CHECK(chunk.bundle().arch() == "smolvla");
    CHECK(chunk.stages(0).name() == "decode");
    CHECK(static_cast<std::size_t>(chunk.stages_size()) == expected->timing.size() + 1);
    double total = 0;
    for (const v1::Stage& stage : chunk.stages()) total += stage.ms();
    CHECK(chunk.engine_ms() == doctest::Approx(total));
  }
}

TEST_CASE("a drawn seed that is sent back gives the same chunk again") {
  Running running;
  Peer peer(running.address());
  v1::Request request = act_request(golden(), 1);
  request.mutable_act()->clear_start();
  const v1::ActionChunk drawn = peer.ask(request).chunk();
  REQUIRE(drawn.has_seed());
  request.mutable_act()->set_seed(drawn.seed());
  const v1::ActionChunk again = peer.ask(request).chunk();
  CHECK(std::equal(drawn.actions().begin(), drawn.actions().end(), again.actions().begin(), again.actions().end()));
}

TEST_CASE("a REQ client is answered like a DEALER, with its delimiter") {
  Running running;
  Peer peer(running.address(), zmq::socket_type::req);
  check_serves(peer);
  check_serves(peer);
}

TEST_CASE("describe tells everything that a client needs to build an act") {
  Running running;
  Peer peer(running.address());
  v1::Request request = request_of(3);
  request.mutable_describe();
  const v1::Response response = peer.ask(request);
  CHECK(response.request_id() == 3);
  const v1::Description& description = response.description();
  CHECK(description.views_size() == 2);
  CHECK(description.states(0).dimensions_size() == 6);
  CHECK(description.noise_rows() * description.d_noise() == golden().noise.size());
  CHECK(description.noise_kind() == "normal");
  CHECK(description.limits().max_views() == 2);
  CHECK(description.bundle().name() == "bundle.gguf");
  CHECK(description.bundle().checksum().starts_with("xxh3:"));
}

TEST_CASE("whatever is wrong with an act is refused with its code and place, and the next act is served") {
  Running running;
  Peer peer(running.address());
  struct Case {
    const char* code;
    const char* where;
    std::function<void(v1::Request&)> spoil;
  };
  const std::vector<Case> cases = {
      {"INCOMPATIBLE", "request.protocol_version", [](auto& r) { r.set_protocol_version(2); }},
      {"BAD_REQUEST", "request", [](auto& r) { r.clear_kind(); }},
      {"BAD_OBSERVATION", "deadline_ms", [](auto& r) { r.mutable_act()->set_deadline_ms(0); }},
      {"BAD_OBSERVATION", "deadline_ms", [](auto& r) { r.mutable_act()->set_deadline_ms(~std::uint64_t{0}); }},
      {"BAD_OBSERVATION", "observation.images.camera1",
       [](auto& r) { r.mutable_act()->mutable_views(0)->mutable_rgb()->set_width(3); }},
      {"BAD_OBSERVATION", "view \"nose\"", [](auto& r) { r.mutable_act()->mutable_views(0)->set_name("nose"); }},
      {"BAD_OBSERVATION", "observation.state[1]",
       [](auto& r) { r.mutable_act()->mutable_states(0)->set_values(1, std::nanf("")); }},
      {"BAD_OBSERVATION", "observation.state", [](auto& r) { r.mutable_act()->mutable_states(0)->add_values(0); }},
      {"BAD_OBSERVATION", "observation.state", [](auto& r) { r.mutable_act()->clear_states(); }},
      {"BAD_OBSERVATION", "instruction", [](auto& r) { r.mutable_act()->clear_text(); }},
      {"BAD_OBSERVATION", "noise", [](auto& r) { r.mutable_act()->mutable_noise()->set_horizon(1); }},
      {"TOO_LARGE", "instruction", [](auto& r) { r.mutable_act()->set_text(std::string(5000, 'x')); }},
  };
  for (const Case& c : cases) {
    CAPTURE(c.where);
    v1::Request request = act_request(golden(), 5);
    c.spoil(request);
    const v1::Response response = peer.ask(request);
    CHECK(response.request_id() == 5);
    CHECK(code_of(response) == c.code);
    CHECK(response.error().where() == c.where);
    CHECK_FALSE(response.error().found().empty());
  }
  check_serves(peer);
}

TEST_CASE("noise that is not finite is refused by the engine's own rule") {
  Running running;
  Peer peer(running.address());
  v1::Request request = act_request(golden(), 5);
  v1::Noise& noise = *request.mutable_act()->mutable_noise();
  noise.set_horizon(static_cast<std::uint32_t>(running.engine->robot().solver_horizon()));
  noise.set_d_action(static_cast<std::uint32_t>(running.engine->robot().d_action_padded()));
  noise.mutable_values()->Add(golden().noise.begin(), golden().noise.end());
  noise.set_values(2, HUGE_VALF);
  CHECK(code_of(peer.ask(request)) == "BAD_OBSERVATION");
  noise.mutable_values()->RemoveLast();
  CHECK(code_of(peer.ask(request)) == "BAD_OBSERVATION");
}

TEST_CASE("garbage, empty messages and several frames are answered bad_request, and the next act is served") {
  Running running;
  Peer peer(running.address());
  std::mt19937 random(1);
  for (int i = 0; i < 200; ++i) {
    std::string bytes(random() % 300, '\0');
    for (char& byte : bytes) byte = static_cast<char>(random());
    const std::string code = code_of(peer.ask(bytes));
    CHECK((code == "BAD_REQUEST" || code == "INCOMPATIBLE"));
  }
  for (const char* first : {"", "x"}) {
    peer.socket.send(zmq::buffer(first, std::strlen(first)), zmq::send_flags::sndmore);
    peer.socket.send(zmq::str_buffer("y"), zmq::send_flags::sndmore);
    peer.socket.send(zmq::str_buffer("z"));
    peer.socket.set(zmq::sockopt::rcvtimeo, 20'000);
    zmq::message_t frame;
    REQUIRE(peer.socket.recv(frame));
    if (*first == '\0') {
      CHECK(frame.size() == 0);
      REQUIRE(peer.socket.recv(frame));
    }
    v1::Response response;
    REQUIRE(response.ParseFromArray(frame.data(), static_cast<int>(frame.size())));
    CHECK(code_of(response) == "BAD_REQUEST");
  }
  check_serves(peer);
}

TEST_CASE("a request over the limit is answered too_large with its number, and the next one is served") {
  serve::ServerOptions options;
  options.max_message = 1 << 20;
  Running running(options);
  Peer large(running.address()), other(running.address());
  check_serves(large);
  v1::Request request = act_request(golden(), 77);
  request.mutable_act()->set_text(std::string(1 << 20, 'x'));
  const v1::Response refused = large.ask(request);
  CHECK(refused.request_id() == 77);
  CHECK(code_of(refused) == "TOO_LARGE");
  CHECK(refused.error().where() == "request");
  check_serves(other);
  check_serves(large);
}

TEST_CASE("bytes that are no ZeroMQ at all do not disturb others") {
  Running running;
  zmq::context_t context;
  zmq::socket_t raw(context, zmq::socket_type::stream);
  raw.set(zmq::sockopt::linger, 0);
  raw.connect(running.address());
  zmq::message_t id, empty;
  REQUIRE(raw.recv(id));
  REQUIRE(raw.recv(empty));
  raw.send(id, zmq::send_flags::sndmore);
  raw.send(zmq::str_buffer("GET / HTTP/1.1\r\n\r\n"));
  Peer peer(running.address());
  check_serves(peer);
}

TEST_CASE("the warm-up runs the largest act that the bundle allows") {
  const auto engine = load_engine(kGolden + "/bundle.gguf");
  const auto ms = serve::warm_up(*engine);
  REQUIRE(ms.ok());
  CHECK(*ms > 0);
}

TEST_CASE("the warm-up shortens a text that would cut the prompt's own tokens") {
  const auto engine = load_engine(golden_path("vla_jepa/libero") + "/bundle.gguf");
  const std::size_t before = engine->memory().plan;
  REQUIRE(serve::warm_up(*engine).ok());
  CHECK(engine->memory().plan > before);
}

}  // namespace server_test
