// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Several policies in one server, which come and go while it answers.
#include "serve/policies.h"

#include <atomic>

#include "serve/support.h"
#include "wire/interface.h"

namespace policies_test {

using namespace vla;
using namespace vla::test;
using serve::Policies;
using serve::ServedPolicy;

namespace {

std::shared_ptr<ServedPolicy> policy_of(const std::string& name, std::uint32_t horizon = 8) {
  auto policy = std::make_shared<ServedPolicy>();
  policy->name = name;
  policy->description.set_horizon(horizon);
  return policy;
}

std::shared_ptr<Engine> another_engine() { return load_engine(kGolden + "/bundle.gguf"); }

v1::Request act_for(const std::string& policy, std::uint64_t request_id) {
  v1::Request request = act_request(golden(), request_id);
  request.mutable_act()->set_policy(policy);
  return request;
}

}  // namespace

TEST_CASE("an act without a name is for the only policy or the default, and any other name is refused with all names") {
  Policies policies("");
  REQUIRE(policies.put(policy_of("pick")));
  CHECK((*policies.find(""))->name == "pick");
  REQUIRE(policies.put(policy_of("place")));
  CHECK(policies.find("").error().message() == "policy: expected one of pick, place, found none");
  CHECK(policies.find("pack").error().message() == "policy: expected one of pick, place, found pack");
  Policies with_default("place");
  CHECK_FALSE(with_default.find(""));
  REQUIRE(with_default.put(policy_of("pick")));
  CHECK_FALSE(with_default.find(""));  // which is not there yet
  REQUIRE(with_default.put(policy_of("place")));
  CHECK((*with_default.find(""))->name == "place");
}

TEST_CASE("the policy that is kept as the default answers those that name none, and stays") {
  Policies policies("");
  REQUIRE(policies.put(policy_of("pick")));
  policies.keep_default("pick");
  REQUIRE(policies.put(policy_of("another")));
  CHECK((*policies.find(""))->name == "pick");
  CHECK(policies.remove("pick").error().code == Code::usage);
}

TEST_CASE("a version takes the place of another only where clients can go on with what they were told") {
  Policies policies("");
  const auto first = policy_of("pick"), second = policy_of("pick");
  second->description.mutable_bundle()->set_checksum("xxh3:2");
  CHECK(*policies.put(first) == nullptr);
  CHECK(*policies.put(second) == first);
  CHECK(policies.put(policy_of("pick", 9)).error().code == Code::incompatible);
  CHECK(*policies.find("pick") == second);
}

TEST_CASE("which bundles robots have is no part of what clients rely on, and which states they have is") {
  v1::Description one;
  one.add_embodiments()->mutable_bundle()->set_checksum("xxh3:1");
  v1::Description other = one;
  other.mutable_embodiments(0)->mutable_bundle()->set_checksum("xxh3:2");
  CHECK(wire::interface_of(one) == wire::interface_of(other));
  other.mutable_embodiments(0)->add_states()->set_name("arm");
  CHECK(wire::interface_of(one) != wire::interface_of(other));
}

TEST_CASE("the last policy and the default stay") {
  Policies policies("pick");
  REQUIRE(policies.put(policy_of("pick")));
  REQUIRE(policies.put(policy_of("place")));
  CHECK(policies.remove("pick").error().code == Code::usage);
  CHECK(policies.remove("").error().code == Code::bad_observation);
  CHECK(policies.remove("pack").error().code == Code::bad_observation);
  REQUIRE(policies.remove("place"));
  CHECK(policies.names() == std::vector<std::string>{"pick"});
  CHECK(policies.remove("pick").error().code == Code::usage);
}

TEST_CASE("policies are loaded, replaced and taken away while acts of all of them are answered") {
  Running running;
  REQUIRE(running.server->load("second", another_engine()));
  std::atomic<bool> done = false;
  std::atomic<int> n_answer = 0;
  const auto ask = [&](const std::string& policy) {
    Peer peer(running.address());
    std::string first;
    for (std::uint64_t id = 1; !done; ++id) {
      const v1::Response response = peer.ask(act_for(policy, id));
      CHECK(code_of(response) == "");
      const v1::ActionChunk& chunk = response.chunk();
      const std::string actions(reinterpret_cast<const char*>(chunk.actions().data()),
                                sizeof(float) * chunk.actions().size());
      if (first.empty()) first = actions;
      CHECK(actions == first);
      ++n_answer;
    }
  };
  std::thread one(ask, "policy"), two(ask, "second");
  for (int round = 0; round < 8; ++round) {
    CHECK(running.server->load("policy", another_engine()));
    CHECK(running.server->load("third", another_engine()));
    const std::weak_ptr<ServedPolicy> third = (*running.server->policies())[2];
    CHECK(third.lock()->name == "third");
    CHECK(running.server->unload("third"));
    CHECK(third.expired());
    for (const int seen = n_answer; n_answer < seen + 4;) std::this_thread::yield();
  }
  done = true;
  one.join();
  two.join();
  Peer peer(running.address());
  CHECK(code_of(peer.ask(act_for("third", 1))) == "BAD_OBSERVATION");
  CHECK(peer.ask(act_request(golden(), 2)).chunk().horizon() > 0);  // of the one that was alone at the start
  CHECK(running.server->unload("policy").error().code == Code::usage);
  v1::Request describe = request_of(3);
  describe.mutable_describe()->set_policy("second");
  const v1::Response described = peer.ask(describe);
  CHECK(described.description().policy() == "second");
  CHECK(described.description().policies_size() == 2);
}

TEST_CASE("a server that drains answers the acts in line and takes no more") {
  Brake brake;
  Running running({}, {}, &brake);
  Peer first(running.address()), second(running.address()), late(running.address());
  first.send(act_request(golden(), 1));
  brake.await(1);
  second.send(act_request(golden(), 2));
  while (running.server->health().n_waiting == 0) std::this_thread::yield();
  running.server->drain();
  while (running.server->health().ready) std::this_thread::yield();
  CHECK(code_of(late.ask(act_request(golden(), 3))) == "SHUTTING_DOWN");
  brake.let_go(2);
  CHECK(first.answer().chunk().horizon() > 0);
  CHECK(second.answer().chunk().horizon() > 0);
  CHECK(running.join().ok());
  CHECK(running.server->load("after", another_engine()).error().code == Code::shutting_down);
}

}  // namespace policies_test
