// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "net/endpoint.h"

#include <doctest/doctest.h>
#include <sys/stat.h>

#include <cstdio>
#include <fstream>

#include "support/editable_bundle.h"
#include "zmtp/curve.h"

namespace endpoint_test {

using namespace vla;
using namespace vla::net;
using namespace vla::zmtp;

TEST_CASE("loopback addresses and ipc paths are local") {
  for (const char* endpoint : {"tcp://127.0.0.1:5555", "tcp://127.9.9.9:0", "tcp://127.0.0.1:*", "tcp://[::1]:5555",
                               "tcp://lo:5555", "tcp://[::ffff:127.0.0.1]:5555", "ipc:///run/vla.sock", "ipc://@vla"}) {
    CAPTURE(endpoint);
    const auto reach = reach_of(endpoint);
    REQUIRE(reach.ok());
    CHECK(*reach == Reach::local);
  }
}

TEST_CASE("every other address is taken to be within reach of other machines") {
  for (const char* endpoint : {"tcp://*:5555", "tcp://0.0.0.0:5555", "tcp://[::]:5555", "tcp://192.168.1.2:5555",
                               "tcp://eth0:5555", "tcp://[::ffff:10.0.0.1]:1", "tcp://128.0.0.1:1", "tcp://lo0:1",
                               "tcp://127.0.0.1.example.org:1", "tcp://::1:5555"}) {
    CAPTURE(endpoint);
    const auto reach = reach_of(endpoint);
    REQUIRE(reach.ok());
    CHECK(*reach == Reach::remote);
  }
}

TEST_CASE("what is no endpoint is refused with an example of one") {
  for (const char* endpoint : {"", "tcp://", "tcp://:5555", "127.0.0.1:5555", "udp://127.0.0.1:5555", "tcp://127.0.0.1",
                               "tcp://127.0.0.1:", "tcp://127.0.0.1:65536", "tcp://127.0.0.1:-1", "tcp://127.0.0.1:5x",
                               "tcp://localhost:5555", "tcp://a;b:1", "ipc://", "inproc://x"}) {
    CAPTURE(endpoint);
    const auto reach = reach_of(endpoint);
    REQUIRE_FALSE(reach.ok());
    CHECK(reach.error().code == Code::usage);
    CHECK(reach.error().hint.find("tcp://127.0.0.1:5555") != std::string::npos);
  }
}

TEST_CASE("a name of a host is refused with the reason") {
  CHECK(reach_of("tcp://localhost:5555").error().message() ==
        "--bind: expected an address or an interface, since names are not looked up, found 'localhost'; for example "
        "tcp://127.0.0.1:5555");
}

TEST_CASE("an ipc path where a file lies is refused, not removed") {
  const std::string file = test::write_file("not_a_socket", "precious");
  const Status free = check_free("ipc://" + file, "--bind");
  REQUIRE_FALSE(free.ok());
  CHECK(free.error().code == Code::io);
  CHECK(test::read_text(file) == "precious");
  CHECK(check_free("ipc://" + file + ".other", "--bind").ok());
  CHECK(check_free("tcp://127.0.0.1:1", "--bind").ok());
}

TEST_CASE("keygen writes a pair that belongs together, a secret for its owner alone, and never over old keys") {
  const std::string prefix = test::scratch_path("keys");
  std::remove((prefix + ".secret").c_str());
  std::remove((prefix + ".public").c_str());
  REQUIRE(write_key_pair(prefix).ok());
  const auto secret = read_secret_key(prefix + ".secret");
  const auto clients = read_public_keys(prefix + ".public");
  REQUIRE(secret.ok());
  REQUIRE(clients.ok());
  CHECK(clients->size() == 1);
  CHECK(*public_key_of(*secret) == *clients->begin());
  struct stat info;
  REQUIRE(stat((prefix + ".secret").c_str(), &info) == 0);
  CHECK((info.st_mode & 0777) == 0600);

  const std::string before = test::read_text(prefix + ".secret");
  CHECK(write_key_pair(prefix).error().code == Code::io);
  std::remove((prefix + ".secret").c_str());
  CHECK(write_key_pair(prefix).error().code == Code::io);  // the public one is still there
  CHECK_FALSE(std::ifstream(prefix + ".secret").good());
  test::write_file("keys.secret", before);
  CHECK(read_secret_key(prefix + ".secret").error().hint.find("chmod 600") != std::string::npos);
}

TEST_CASE("a file of client keys may have remarks, and anything else in it is refused with its line") {
  const std::string key = "rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7";
  const auto keys = read_public_keys(test::write_file("clients", "# robots\n" + key + " left arm\n\n"));
  REQUIRE_MESSAGE(keys.ok(), (keys ? "" : keys.error().message()));
  CHECK(*keys == std::set<std::string>{key});
  const auto bad = read_public_keys(test::write_file("clients", key + "\nnot a key\n"));
  REQUIRE_FALSE(bad.ok());
  CHECK(bad.error().where.ends_with("clients:2"));
  CHECK_FALSE(read_public_keys(test::write_file("clients", "# none\n")).ok());
  CHECK_FALSE(read_public_keys(test::scratch_path("absent")).ok());
}

}  // namespace endpoint_test
