// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Which addresses the server takes, and whom it lets in.
#include <cstdio>
#include <set>

#include "serve/support.h"
#include "zmtp/curve.h"

namespace access_test {

using namespace vla;
using namespace vla::test;

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
    REQUIRE(zmtp::write_key_pair(prefix + who).ok());
  }
  options.curve_secret = prefix + ".server.secret";
  CHECK(serve::Server::open(options).error().where == "--curve-secret");
  options.curve_clients = prefix + ".friend.public";
  struct Names : observe::Observer {  // who is there, as the server sees it
    std::set<std::string> peers;
    void received(const observe::Received& request) override { peers.insert(request.peer); }
  } names;
  Running running(options, {&names});
  const auto connect = [&](const std::string& who) {
    auto peer = std::make_unique<Peer>("inproc://nowhere");
    const std::string secret = *zmtp::read_secret_key(prefix + who + ".secret");
    peer->socket.set(zmq::sockopt::curve_serverkey, *zmtp::public_key_of(*zmtp::read_secret_key(options.curve_secret)));
    peer->socket.set(zmq::sockopt::curve_publickey, *zmtp::public_key_of(secret));
    peer->socket.set(zmq::sockopt::curve_secretkey, secret);
    peer->socket.disconnect("inproc://nowhere");
    peer->socket.connect(running.address());
    return peer;
  };
  const std::string act = act_request(golden(), 1).SerializeAsString();
  // To a peer that was turned away ZeroMQ has nowhere to put a message, and would wait for ever.
  const auto send = [&](Peer& peer) { (void)peer.socket.send(zmq::buffer(act), zmq::send_flags::dontwait); };
  const auto stranger = connect(".stranger");
  send(*stranger);
  Peer open_text(running.address());
  send(open_text);
  check_serves(*connect(".friend"));
  CHECK_FALSE(stranger->receive(200).has_value());
  CHECK_FALSE(open_text.receive(1).has_value());
  running.server->stop();
  CHECK(running.join().ok());
  const std::string friends_key = *zmtp::public_key_of(*zmtp::read_secret_key(prefix + ".friend.secret"));
  CHECK(names.peers == std::set<std::string>{friends_key});
}

}  // namespace access_test
