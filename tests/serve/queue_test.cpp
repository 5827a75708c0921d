// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/queue.h"

#include <doctest/doctest.h>

#include <map>
#include <random>
#include <set>

#include "net/eviction.h"

namespace queue_test {

using namespace vla::serve;
using vla::Clock;

namespace {

struct Item {
  std::string client;
  int number = 0;
  std::size_t size = 1;
  std::optional<Clock::time_point> deadline = {};
  vla::net::Share share = {};
};

Clock::time_point at(int ms) { return Clock::time_point(std::chrono::milliseconds(ms)); }

constexpr Queue<Item>::Limits kRoom = {100, 100};

}  // namespace

TEST_CASE("a client that waits keeps its place, and its newest act is the one that is computed") {
  Queue<Item> queue(kRoom);
  queue.push({"a", 1});
  queue.push({"b", 2});
  const auto pushed = queue.push({"a", 3});
  REQUIRE(pushed.superseded);
  CHECK(pushed.superseded->number == 1);
  CHECK(queue.size() == 2);
  CHECK(queue.pop()->number == 3);
  CHECK(queue.pop()->number == 2);
  CHECK_FALSE(queue.pop());
}

TEST_CASE("a full queue refuses a new client and still takes the newest act of one that waits") {
  Queue<Item> queue({2, 100});
  queue.push({"a", 1});
  queue.push({"b", 2});
  CHECK(queue.push({"c", 3}).refused.at(0).number == 3);
  CHECK(queue.push({"a", 4}).superseded->number == 1);
  CHECK(queue.size() == 2);
}

TEST_CASE("bytes are bounded, counting what a newer act frees") {
  Queue<Item> queue({10, 10});
  queue.push({"a", 1, 6});
  CHECK(queue.push({"b", 2, 5}).refused.size() == 1);
  CHECK(queue.push({"a", 3, 10}).superseded);
  CHECK(queue.push({"a", 4, 11}).refused.at(0).number == 4);
  CHECK(queue.pop()->number == 3);
  CHECK(queue.push({"b", 5, 10}).refused.empty());
}

TEST_CASE("an act is late from its deadline on, not before") {
  Queue<Item> queue(kRoom);
  queue.push({"a", 1, 1, at(10)});
  queue.push({"b", 2, 1});
  CHECK(queue.first_deadline() == at(10));
  CHECK_FALSE(queue.take_late(at(9)));
  CHECK(queue.take_late(at(10))->number == 1);
  CHECK_FALSE(queue.take_late(at(10)));
  CHECK_FALSE(queue.first_deadline());
  CHECK(queue.pop()->number == 2);
}

TEST_CASE("a peer of seventy connections gets as many turns as a peer of one") {
  Queue<Item> queue(kRoom);
  for (int i = 0; i < 70; ++i) queue.push({"many" + std::to_string(i), i, 1, {}, {"many"}});
  for (int turn = 0; turn < 5; ++turn) {
    queue.push({"one", 100 + turn, 1, {}, {"one"}});
    std::set<std::string> served = {queue.pop()->share.group, queue.pop()->share.group};
    CHECK(served == std::set<std::string>{"many", "one"});
  }
}

namespace {

/// Whose the next turns are, as letters, where a flood of 70 connections always waits.
std::string turns(Queue<Item>& queue, int n, const std::string& flood, const std::string& robots = "", int since = 0) {
  std::string out;
  for (int i = 0; i < 4 && !robots.empty(); ++i) queue.push({"r" + std::to_string(i), i, 1, {}, {robots, at(since)}});
  for (int turn = 0; turn < n; ++turn) {
    for (int i = 0; i < 70; ++i) queue.push({"f" + std::to_string(i), i, 1, {}, {flood, at(5000 + i)}});
    out += queue.pop()->client[0];
  }
  return out;
}

}  // namespace

TEST_CASE("robots that came before a flood, and ask for less than half of the turns, wait for none of its acts") {
  for (const std::string flood : {"another", "robots"}) {
    CAPTURE(flood);
    Queue<Item> queue(kRoom);
    turns(queue, 40, flood);
    for (int round = 0; round < 50; ++round) CHECK(turns(queue, 10, flood, "robots", 0) == "rrrrffffff");
    for (int round = 0; round < 5; ++round)
      CHECK(turns(queue, 10, flood, "robots", 9000).find("rr") == std::string::npos);
  }
}

TEST_CASE("who came first gets no more than half of the turns, nor many in a row") {
  Queue<Item> queue(kRoom);
  turns(queue, 40, "flood");
  std::string out;
  for (int turn = 0; turn < 100; ++turn) out += turns(queue, 1, "flood", "robots", 0);
  CHECK(out.find_first_not_of('r') == Queue<Item>::kRecent / 2);
  CHECK(out.substr(Queue<Item>::kRecent).find("rr") == std::string::npos);
}

TEST_CASE("in a crowd of one peer, a connection of another age gets every second turn") {
  for (const int since : {0, 9900}) {
    Queue<Item> queue(kRoom);
    for (int i = 0; i < 70; ++i) queue.push({"flood" + std::to_string(i), i, 1, {}, {"here", at(5000 + 50 * i)}});
    int n_robot = 0;
    for (int turn = 0; turn < 20; ++turn) {
      queue.push({"robot", 100, 1, {}, {"here", at(since)}});
      n_robot += queue.pop()->client == "robot";
    }
    CHECK(n_robot == 10);
  }
}

TEST_CASE("in a crowd whose connections come and go all the time, an old one waits for few turns") {
  Queue<Item> queue(kRoom);
  int now = 100'000, waited = 0, longest = 0;
  for (int i = 0; i < 60; ++i) queue.push({"flood" + std::to_string(i), i, 1, {}, {"here", at(now += 1000)}});
  for (int turn = 0; turn < 1000; ++turn) {
    queue.push({"robot", 100, 1, {}, {"here", at(0)}});
    const auto item = queue.pop();
    longest = std::max(longest, waited);
    waited = item->client == "robot" ? 0 : waited + 1;
    if (waited > 0) queue.push({"flood" + std::to_string(now), 0, 1, {}, {"here", at(now += 1000)}});
  }
  CHECK(longest < static_cast<int>(Generations::kMax));
}

TEST_CASE("connections are cut into generations where the gaps are widest") {
  const Generations one({at(0), at(999), at(1998)});
  CHECK(one.size() == 1);
  CHECK(one.of(at(1998)) == 0);
  const Generations two({at(60'000), at(0), at(59'500)});
  CHECK(two.size() == 2);
  CHECK(two.of(at(0)) == 0);
  CHECK(two.of(at(59'500)) == 1);
  CHECK(two.of(at(60'000)) == 1);
  std::vector<Clock::time_point> many = {at(0)};
  for (int i = 0; i < 60; ++i) many.push_back(at(100'000 + 1000 * i));
  const Generations most(many);
  CHECK(most.size() == Generations::kMax);
  CHECK(most.of(at(0)) == 0);
  CHECK(most.of(at(100'000)) == 1);
}

TEST_CASE("a few clients of one peer take turns, whatever their age") {
  Queue<Item> queue(kRoom);
  for (int i = 0; i < 8; ++i) queue.push({std::to_string(i), i, 1, {}, {"here", at(2000 * i)}});
  for (int turn = 0; turn < 24; ++turn) {
    const auto item = queue.pop();
    CHECK(item->number == turn % 8);
    queue.push(*item);
  }
}

TEST_CASE("where the queue is full of one peer's acts, the generation that has most gives way to one that has less") {
  Queue<Item> queue({3, 100});
  for (int i = 0; i < 3; ++i) queue.push({"flood" + std::to_string(i), i, 1, {}, {"here", at(6000)}});
  CHECK(queue.push({"robot", 3, 1, {}, {"here", at(0)}}).refused.at(0).number == 2);
  CHECK(queue.push({"flood3", 4, 1, {}, {"here", at(6000)}}).refused.at(0).number == 4);
}

TEST_CASE("where a crowded peer gives way to another one, its largest generation does") {
  Queue<Item> queue({4, 100});
  for (int i = 0; i < 3; ++i) queue.push({"flood" + std::to_string(i), i, 1, {}, {"here", at(6000)}});
  queue.push({"robot", 3, 1, {}, {"here", at(0)}});
  CHECK(queue.push({"other0", 4, 1, {}, {"there"}}).refused.at(0).number == 2);
  CHECK(queue.push({"other1", 5, 1, {}, {"there"}}).refused.at(0).number == 1);
  CHECK(queue.push({"other2", 6, 1, {}, {"there"}}).refused.at(0).number == 6);
}

TEST_CASE("where the queue is full, the last act of the peer that has most gives way to a peer that has less") {
  Queue<Item> queue({3, 100});
  for (int i = 0; i < 3; ++i) queue.push({"a" + std::to_string(i), i, 1, {}, {"a"}});
  CHECK(queue.push({"a3", 3, 1, {}, {"a"}}).refused.at(0).number == 3);
  CHECK(queue.push({"b0", 4, 1, {}, {"b"}}).refused.at(0).number == 2);
  CHECK(queue.push({"b1", 5, 1, {}, {"b"}}).refused.at(0).number == 5);  // it would have as many
  CHECK(queue.push({"c0", 6, 1, {}, {"c"}}).refused.at(0).number == 1);
  CHECK(queue.push({"d0", 7, 1, {}, {"d"}}).refused.at(0).number == 7);  // all have the same
  CHECK(queue.size() == 3);
}

TEST_CASE("bytes too are taken from the peer that has most of them") {
  Queue<Item> queue({10, 10});
  queue.push({"a0", 0, 5, {}, {"a"}});
  queue.push({"a1", 1, 4, {}, {"a"}});
  const auto pushed = queue.push({"b0", 2, 4, {}, {"b"}});
  REQUIRE(pushed.refused.size() == 1);
  CHECK(pushed.refused[0].number == 1);
  CHECK(queue.push({"b1", 3, 6, {}, {"b"}}).refused.at(0).number == 3);
  CHECK(queue.size() == 2);
}

TEST_CASE("over random traffic every act comes out once, bounds hold, and nobody is passed over twice") {
  for (unsigned seed = 0; seed < 200; ++seed) {
    CAPTURE(seed);
    std::mt19937 random(seed);
    const auto draw = [&](int n) { return static_cast<int>(random() % static_cast<unsigned>(n)); };
    const Queue<Item>::Limits limits = {static_cast<std::size_t>(1 + draw(8)), static_cast<std::size_t>(5 + draw(40))};
    Queue<Item> queue(limits);
    std::set<int> out;                     // numbers that came back, each once
    std::map<std::string, int> newest;     // of the clients that wait
    std::map<std::string, int> passed_by;  // how often others were served since the client began to wait
    std::size_t bytes = 0;
    std::map<int, std::size_t> sizes;
    int n = 0;
    const auto leaves = [&](const Item& item) {
      CHECK(out.insert(item.number).second);
      bytes -= sizes[item.number];
    };
    for (int now = 0; now < 400; ++now) {
      if (draw(3) != 0) {
        Item item{std::string(1, static_cast<char>('a' + draw(10))), n++, static_cast<std::size_t>(1 + draw(9))};
        if (draw(4) == 0) item.deadline = at(now + 1 + draw(30));
        bytes += sizes[item.number] = item.size;
        const std::string client = item.client;
        const int number = item.number;
        const auto pushed = queue.push(std::move(item));
        if (pushed.superseded) {
          CHECK(pushed.superseded->number == newest.at(client));
          leaves(*pushed.superseded);
        }
        if (!pushed.refused.empty()) {
          CHECK(pushed.refused.size() == 1);
          CHECK(pushed.refused[0].number == number);
          leaves(pushed.refused[0]);
        } else {
          if (!newest.contains(client)) passed_by[client] = 0;
          newest[client] = number;
        }
      }
      while (const auto late = queue.take_late(at(now))) {
        CHECK(*late->deadline <= at(now));
        CHECK(newest.at(late->client) == late->number);
        leaves(*late);
        newest.erase(late->client);
      }
      if (draw(3) == 0) {
        if (const auto item = queue.pop()) {
          CHECK((!item->deadline || *item->deadline > at(now)));
          CHECK(newest.at(item->client) == item->number);
          leaves(*item);
          newest.erase(item->client);
          // Round robin: since a client began to wait, no more turns went to others than clients can stand before it.
          CHECK(passed_by[item->client] < static_cast<int>(limits.jobs));
          for (const auto& [client, number] : newest) ++passed_by[client];
        }
      }
      CHECK(queue.size() == newest.size());
      CHECK(queue.size() <= limits.jobs);
      CHECK(bytes <= limits.bytes);
    }
    while (const auto item = queue.pop()) leaves(*item);
    CHECK(out.size() == static_cast<std::size_t>(n));
    CHECK(bytes == 0);
  }
}

}  // namespace queue_test
