// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/server.h"

#include <bit>
#include <cmath>
#include <fstream>
#include <random>

#include "serve/support.h"

using namespace vla;
using namespace vla::test;

namespace {

const GoldenCase& golden() {
  static const GoldenCase read = GoldenCase::read(kGolden);
  return read;
}

std::string code_of(const v1::Response& response) {
  return response.has_error() ? v1::Error::Code_Name(response.error().code()) : "";
}

void check_serves(Peer& peer) {
  const v1::Response response = peer.ask(act_request(golden(), 4242));
  CHECK(response.request_id() == 4242);
  CHECK(response.chunk().horizon() > 0);
}

}  // namespace

TEST_CASE("an act through the server gives the bytes that the engine gives, from noise and from a seed") {
  Running running;
  Peer peer(running.address());
  const auto engine = load_engine(kGolden + "/bundle.gguf");
  v1::Request request = act_request(golden(), 1);
  for (const Noise& noise : {Noise(golden().noise), Noise(std::uint64_t{99})}) {
    if (const auto* values = std::get_if<std::vector<float>>(&noise)) {
      v1::Noise& sent = *request.mutable_act()->mutable_noise();
      sent.set_horizon(static_cast<std::uint32_t>(engine->horizon()));
      sent.set_d_action(static_cast<std::uint32_t>(engine->d_action()));
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
  CHECK(description.horizon() * description.d_noise() == golden().noise.size());
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
      {"BAD_OBSERVATION", "act.deadline_ms", [](auto& r) { r.mutable_act()->set_deadline_ms(0); }},
      {"BAD_OBSERVATION", "act.deadline_ms", [](auto& r) { r.mutable_act()->set_deadline_ms(~std::uint64_t{0}); }},
      {"BAD_OBSERVATION", "act.views[\"camera1\"]",
       [](auto& r) { r.mutable_act()->mutable_views(0)->mutable_rgb()->set_width(3); }},
      {"BAD_OBSERVATION", "observation view \"nose\"",
       [](auto& r) { r.mutable_act()->mutable_views(0)->set_name("nose"); }},
      {"BAD_OBSERVATION", "observation.state[1]",
       [](auto& r) { r.mutable_act()->mutable_states(0)->set_values(1, std::nanf("")); }},
      {"BAD_OBSERVATION", "observation.state", [](auto& r) { r.mutable_act()->mutable_states(0)->add_values(0); }},
      {"BAD_OBSERVATION", "observation.state", [](auto& r) { r.mutable_act()->clear_states(); }},
      {"BAD_OBSERVATION", "instruction", [](auto& r) { r.mutable_act()->clear_text(); }},
      {"BAD_OBSERVATION", "act.noise", [](auto& r) { r.mutable_act()->mutable_noise()->set_horizon(1); }},
      {"TOO_LARGE", "act.text", [](auto& r) { r.mutable_act()->set_text(std::string(5000, 'x')); }},
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
  noise.set_horizon(static_cast<std::uint32_t>(running.engine->horizon()));
  noise.set_d_action(static_cast<std::uint32_t>(running.engine->d_action()));
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

TEST_CASE("a message over the limit costs its sender the connection and nobody else anything") {
  serve::ServerOptions options;
  options.max_message = 1 << 20;
  Running running(options);
  Peer large(running.address()), other(running.address());
  check_serves(large);
  large.send(std::string((1 << 20) + 1, 'x'));
  CHECK_FALSE(large.receive(300).has_value());
  check_serves(other);
  check_serves(large);  // ZeroMQ has connected again
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

TEST_CASE("of two acts of one client that wait, the older is answered superseded and the newer is computed") {
  Brake brake;
  Running running({}, {&brake});
  Peer peer(running.address());
  peer.send(act_request(golden(), 1));
  brake.await(1);
  peer.send(act_request(golden(), 2));
  peer.send(act_request(golden(), 3));
  const auto superseded = peer.receive();
  CHECK(superseded->request_id() == 2);
  CHECK(code_of(*superseded) == "SUPERSEDED");
  CHECK(superseded->error().found().find("request 3") != std::string::npos);
  brake.let_go(2);
  CHECK(peer.receive()->request_id() == 1);
  const auto newest = peer.receive();
  CHECK(newest->request_id() == 3);
  CHECK(newest->has_chunk());
}

TEST_CASE("an act of a few bytes waits in the queue as it came") {
  Brake brake;
  Running running({}, {&brake});
  Peer first(running.address()), second(running.address());
  first.send(act_request(golden(), 1));
  brake.await(1);
  v1::Request request = request_of(2);
  request.mutable_act()->set_text("no views");
  second.send(request);
  brake.let_go(2);
  CHECK(first.receive()->has_chunk());
  const v1::Response refused = *second.receive();
  CHECK(refused.request_id() == 2);
  CHECK(refused.error().where() == "observation.images.camera1");
}

TEST_CASE("an act whose deadline passes while it waits is answered late, not computed") {
  Brake brake;
  Running running({}, {&brake});
  Peer first(running.address()), second(running.address());
  first.send(act_request(golden(), 1));
  brake.await(1);
  v1::Request hurried = act_request(golden(), 2);
  hurried.mutable_act()->set_deadline_ms(1);
  second.send(hurried);
  std::this_thread::sleep_for(std::chrono::milliseconds(50));
  brake.let_go(1);
  CHECK(first.receive()->has_chunk());
  CHECK(code_of(*second.receive()) == "LATE");
  hurried.mutable_act()->set_deadline_ms(60'000);
  brake.let_go(1);
  CHECK(second.ask(hurried).has_chunk());
}

TEST_CASE("a full queue answers busy to a further client, and those that wait are still served") {
  Brake brake;
  serve::ServerOptions options;
  options.max_queue = 1;
  Running running(options, {&brake});
  Peer a(running.address()), b(running.address()), c(running.address());
  a.send(act_request(golden(), 1));
  brake.await(1);
  b.send(act_request(golden(), 2));
  v1::Request health = request_of(9);
  health.mutable_health();
  while (b.ask(health).health().queue_depth() < 1) {
  }
  CHECK(code_of(c.ask(act_request(golden(), 3))) == "BUSY");
  brake.let_go(2);
  CHECK(a.receive()->has_chunk());
  CHECK(b.receive()->has_chunk());
}

TEST_CASE("health and describe are answered while the engine computes") {
  Brake brake;
  Running running({}, {&brake});
  Peer busy(running.address()), other(running.address());
  busy.send(act_request(golden(), 1));
  brake.await(1);
  v1::Request request = request_of(2);
  request.mutable_health();
  const v1::HealthReply health = other.ask(request).health();
  CHECK(health.ready());
  CHECK(health.computing());
  CHECK(health.queue_depth() == 0);
  request.mutable_describe();
  CHECK(other.ask(request).has_description());
  brake.let_go();
  CHECK(busy.receive()->has_chunk());
  request.mutable_health();
  CHECK(other.ask(request).health().chunks_served() == 1);
}

TEST_CASE("a server that is told to stop answers what waits, takes nothing new, and ends without an error") {
  Brake brake;
  Running running({}, {&brake});
  Peer a(running.address()), b(running.address()), c(running.address());
  a.send(act_request(golden(), 1));
  brake.await(1);
  b.send(act_request(golden(), 2));
  v1::Request health = request_of(9);
  health.mutable_health();
  while (b.ask(health).health().queue_depth() < 1) {
  }
  CHECK(c.ask(health).health().ready());
  running.server->stop();
  while (c.ask(health).health().ready()) {
  }
  CHECK(code_of(c.ask(act_request(golden(), 3))) == "SHUTTING_DOWN");
  brake.let_go(2);
  CHECK(running.join().ok());
  CHECK(a.receive()->has_chunk());
  CHECK(b.receive()->has_chunk());
}

TEST_CASE("many clients at once get each their own answers, with the bytes that they get alone") {
  Running running;
  constexpr int kClients = 24, kRounds = 8;
  std::vector<std::vector<float>> alone(kClients);
  Peer peer(running.address());
  for (int i = 0; i < kClients; ++i) {
    v1::Request request = act_request(golden(), 1);
    request.mutable_act()->set_seed(static_cast<std::uint64_t>(i));
    const v1::ActionChunk chunk = peer.ask(request).chunk();
    alone[static_cast<std::size_t>(i)].assign(chunk.actions().begin(), chunk.actions().end());
  }
  std::vector<std::thread> threads;
  std::atomic<int> wrong = 0;
  for (int i = 0; i < kClients; ++i)
    threads.emplace_back([&, i] {
      Peer client(running.address());
      for (int round = 0; round < kRounds; ++round) {
        const auto id = static_cast<std::uint64_t>(1000 * i + round);
        v1::Request request = act_request(golden(), id);
        request.mutable_act()->set_seed(static_cast<std::uint64_t>(i));
        client.send(request);
        const auto response = client.receive(120'000);
        const auto& expected = alone[static_cast<std::size_t>(i)];
        if (!response || response->request_id() != id ||
            !std::equal(expected.begin(), expected.end(), response->chunk().actions().begin(),
                        response->chunk().actions().end()))
          ++wrong;
      }
    });
  for (std::thread& thread : threads) thread.join();
  CHECK(wrong == 0);
}

TEST_CASE("clients that never read, or that go away while their act waits, cost others nothing") {
  Running running;
  Peer deaf(running.address()), peer(running.address());
  deaf.socket.set(zmq::sockopt::rcvhwm, 1);
  v1::Request describe = request_of(1);
  describe.mutable_describe();
  const std::string bytes = describe.SerializeAsString();
  for (int i = 0; i < 5000; ++i) deaf.socket.send(zmq::buffer(bytes), zmq::send_flags::dontwait);
  for (int i = 0; i < 5; ++i) {
    Peer gone(running.address());
    gone.send(act_request(golden(), 1));
  }
  check_serves(peer);
}

TEST_CASE("an address that others can reach takes keys or the word that everybody may come in") {
  serve::ServerOptions options;
  options.bind = {"tcp://127.0.0.1:0", "tcp://0.0.0.0:0"};
  const auto refused = serve::Server::open(options);
  REQUIRE_FALSE(refused.ok());
  CHECK(refused.error().code == Code::usage);
  CHECK(refused.error().hint.find("--insecure") != std::string::npos);
  options.insecure = true;
  const auto opened = serve::Server::open(options);
  REQUIRE(opened.ok());
  CHECK((*opened)->addresses().size() == 2);
}

TEST_CASE("an address in use is refused with the next move, over tcp and over ipc") {
  for (const std::string& endpoint : {std::string("tcp://127.0.0.1:0"), "ipc://" + scratch_path("socket")}) {
    serve::ServerOptions options;
    options.bind = {endpoint};
    const auto first = serve::Server::open(options);
    REQUIRE(first.ok());
    options.bind = (*first)->addresses();
    const auto second = serve::Server::open(options);
    REQUIRE_FALSE(second.ok());
    CHECK(second.error().code == Code::io);
    CHECK(second.error().hint.find("--bind") != std::string::npos);
  }
}

TEST_CASE("with keys, a listed client is served and every other one is not") {
  serve::ServerOptions options;
  const std::string prefix = scratch_path("curve");
  for (const char* who : {".server", ".friend", ".stranger"}) {
    std::remove((prefix + who + ".secret").c_str());
    std::remove((prefix + who + ".public").c_str());
    REQUIRE(serve::write_key_pair(prefix + who).ok());
  }
  options.curve_secret = prefix + ".server.secret";
  CHECK(serve::Server::open(options).error().where == "--curve-secret");
  options.curve_clients = prefix + ".friend.public";
  Running running(options);
  const auto connect = [&](const std::string& who) {
    auto peer = std::make_unique<Peer>("inproc://nowhere");
    const std::string secret = *serve::read_secret_key(prefix + who + ".secret");
    peer->socket.set(zmq::sockopt::curve_serverkey,
                     *serve::public_key_of(*serve::read_secret_key(options.curve_secret)));
    peer->socket.set(zmq::sockopt::curve_publickey, *serve::public_key_of(secret));
    peer->socket.set(zmq::sockopt::curve_secretkey, secret);
    peer->socket.disconnect("inproc://nowhere");
    peer->socket.connect(running.address());
    return peer;
  };
  const auto stranger = connect(".stranger");
  stranger->send(act_request(golden(), 1));
  Peer open_text(running.address());
  open_text.send(act_request(golden(), 1));
  check_serves(*connect(".friend"));
  CHECK_FALSE(stranger->receive(200).has_value());
  CHECK_FALSE(open_text.receive(1).has_value());
}

TEST_CASE("the warm-up runs the largest act that the bundle allows") {
  const auto engine = load_engine(kGolden + "/bundle.gguf");
  const auto ms = serve::warm_up(*engine);
  REQUIRE(ms.ok());
  CHECK(*ms > 0);
}
