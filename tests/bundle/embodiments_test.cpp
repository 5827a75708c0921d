// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Several robots in one bundle.
#include <doctest/doctest.h>

#include "bundle/bundle.h"
#include "bundle/params.h"
#include "support/editable_bundle.h"

namespace embodiments_test {

using namespace vla;
using test::EditableBundle;

namespace {

const std::vector<std::string> kTags = {"arm", "humanoid"};

/// Both robots share lm.weight and lm.d_model; each has a state_in.weight and a policy.max_views of its own.
EditableBundle two_robots() {
  EditableBundle bundle;
  bundle.set("vla.bundle_version", Value(std::int64_t{1}));
  for (const auto& [key, value] : {std::pair("vla.arch", "gr00t_n1_7"),
                                   {"vla.dtype", "f32"},
                                   {"vla.source.name", "x"},
                                   {"vla.source.revision", ""},
                                   {"vla.source.converter", "test"}})
    bundle.set(key, Value(std::string(value)));
  bundle.set("embodiments", Value(kTags));
  bundle.set("lm.d_model", Value(std::int64_t{4}));
  bundle.set("embodiment.arm.policy.max_views", Value(std::int64_t{1}));
  bundle.set("embodiment.humanoid.policy.max_views", Value(std::int64_t{2}));
  bundle.tensors.push_back({"lm.weight", DType::f32, {4, 2}, std::string(32, '\1')});
  bundle.tensors.push_back({"embodiment.arm.state_in.weight", DType::f32, {3, 4}, std::string(48, '\2')});
  bundle.tensors.push_back({"embodiment.humanoid.state_in.weight", DType::f32, {5, 4}, std::string(80, '\3')});
  bundle.tensors.push_back({"embodiment.humanoid.stats.x", DType::f32, {3}, std::string(12, '\0')});
  return bundle;
}

Result<Bundle> parse(const std::string& bytes) { return Bundle::parse(std::as_bytes(std::span(bytes)), "test.gguf"); }

std::string refusal(const EditableBundle& bundle) {
  const std::string bytes = bundle.bytes();
  const auto parsed = parse(bytes);
  REQUIRE_FALSE(parsed.ok());
  CHECK(parsed.error().code == Code::bad_bundle);
  return parsed.error().message();
}

bool contains(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

}  // namespace

TEST_CASE("the bundle of a robot has what is its own under the plain name, and nothing of the others") {
  const std::string bytes = two_robots().bytes();
  auto bundle = parse(bytes);
  REQUIRE_MESSAGE(bundle.ok(), (bundle ? "" : bundle.error().message()));
  CHECK(bundle->embodiments() == kTags);
  CHECK(bundle->embodiment().empty());
  REQUIRE(bundle->choose("humanoid").ok());
  CHECK(bundle->embodiment() == "humanoid");
  CHECK(bundle->embodiments() == kTags);
  CHECK(*bundle->keys().integer("policy.max_views", kAnySize) == 2);
  CHECK(*bundle->keys().integer("lm.d_model", kAnySize) == 4);
  for (const auto& [key, value] : bundle->keys().all()) CHECK_FALSE(key.starts_with("embodiment"));
  CHECK(bundle->tensors().size() == 3);
  REQUIRE(bundle->find("state_in.weight") != nullptr);
  CHECK(bundle->find("state_in.weight")->shape == std::vector<std::int64_t>{5, 4});
  CHECK(bundle->find("state_in.weight")->data.front() == std::byte{3});
  CHECK(bundle->find("lm.weight") != nullptr);
  CHECK(bundle->find("embodiment.humanoid.state_in.weight") == nullptr);
  CHECK(bundle->stats("stats.x").ok());
}

TEST_CASE("of several robots one is chosen by its tag, and a wrong one is answered with the list") {
  const std::string bytes = two_robots().bytes();
  for (const std::string tag : {"", "arms", "embodiment.arm"}) {
    auto bundle = parse(bytes);
    const Status chosen = bundle->choose(tag);
    REQUIRE_FALSE(chosen.ok());
    CHECK(chosen.error().code == Code::usage);
    CHECK(chosen.error().expected == "one of arm, humanoid");
    CHECK(chosen.error().found == (tag.empty() ? "none" : tag));
  }
}

TEST_CASE("a bundle of one robot takes no tag") {
  EditableBundle one = two_robots();
  one.remove_key("embodiments");
  for (const char* tag : {"arm", "humanoid"}) one.remove_key(std::string("embodiment.") + tag + ".policy.max_views");
  std::erase_if(one.tensors, [](const auto& tensor) { return tensor.name != "lm.weight"; });
  const std::string bytes = one.bytes();
  auto bundle = parse(bytes);
  CHECK(bundle->choose("").ok());
  const Status chosen = bundle->choose("arm");
  REQUIRE_FALSE(chosen.ok());
  CHECK(contains(chosen.error().message(), "is for one robot, which it does not name, found arm"));
}

TEST_CASE("a part of a robot that is not listed is refused") {
  EditableBundle key = two_robots();
  key.set("embodiment.dog.policy.max_views", Value(std::int64_t{1}));
  CHECK(contains(refusal(key),
                 "embodiment.dog.policy.max_views: expected embodiment.<tag>.<name> with a tag of arm, "
                 "humanoid, found tag dog"));
  EditableBundle tensor = two_robots();
  tensor.tensors.push_back({"embodiment.dog.weight", DType::f32, {1}, std::string(4, '\0')});
  CHECK(contains(refusal(tensor), "tensor embodiment.dog.weight: expected embodiment.<tag>.<name>"));
  EditableBundle unlisted = two_robots();
  unlisted.remove_key("embodiments");
  CHECK(contains(refusal(unlisted), "no such name, since there is no key embodiments"));
  EditableBundle nameless = two_robots();
  nameless.set("embodiment.arm", Value(std::int64_t{1}));
  CHECK(contains(refusal(nameless), "embodiment.arm: expected embodiment.<tag>.<name>"));
}

TEST_CASE("what is shared and also a robot's own is refused, since one of them would be ignored") {
  EditableBundle key = two_robots();
  key.set("embodiment.arm.lm.d_model", Value(std::int64_t{4}));
  CHECK(contains(refusal(key), "embodiment.arm.lm.d_model: expected a name that is not shared"));
  EditableBundle tensor = two_robots();
  tensor.tensors.push_back({"embodiment.arm.lm.weight", DType::f32, {1}, std::string(4, '\0')});
  CHECK(contains(refusal(tensor), "tensor embodiment.arm.lm.weight: expected a name that is not shared"));
}

TEST_CASE("tags are at least two, all different, none empty or with a dot") {
  for (const std::vector<std::string>& tags :
       {std::vector<std::string>{}, {"arm"}, {"arm", "arm"}, {"arm", "humanoid", "arm"}, {"arm", ""}, {"arm", "a.b"}}) {
    EditableBundle bundle = two_robots();
    bundle.set("embodiments", Value(tags));
    CHECK(contains(refusal(bundle), "embodiments: expected "));
  }
}

TEST_CASE("tags are few and short: every robot is loaded for itself, and refusals list them") {
  EditableBundle bundle = two_robots();
  std::vector<std::string> tags = kTags;
  for (int i = 0; i < 62; ++i) tags.push_back("robot " + std::to_string(i));
  bundle.set("embodiments", Value(tags));
  CHECK(parse(bundle.bytes()).ok());
  tags.push_back("one more");
  bundle.set("embodiments", Value(tags));
  CHECK(contains(refusal(bundle), "embodiments: expected 2 to 64 tags, found 65"));
  tags = kTags;
  tags.emplace_back(257, 'x');
  bundle.set("embodiments", Value(tags));
  CHECK(contains(refusal(bundle), "embodiments: expected tags of 1 to 256 bytes"));
}

TEST_CASE("tags, and names that are one robot's own, have no control characters") {
  EditableBundle tag = two_robots();
  tag.set("embodiments", Value(std::vector<std::string>{"arm", "humanoid", "\x1b[2J"}));
  CHECK(contains(refusal(tag), "embodiments: expected text without control characters"));
  EditableBundle name = two_robots();
  name.set("embodiment.arm.action.names", Value(std::vector<std::string>{"x\nready address=y"}));
  CHECK(contains(refusal(name), "embodiment.arm.action.names: expected text without control characters"));
  EditableBundle prompt = two_robots();
  prompt.set("embodiment.arm.processor.recipe", Value(std::string("{\n}")));
  CHECK(parse(prompt.bytes()).ok());
}

TEST_CASE("a parameter that robots share is declared once, and one of their own for each") {
  const std::string bytes = two_robots().bytes();
  auto arm = parse(bytes), humanoid = parse(bytes);
  REQUIRE(arm->choose("arm").ok());
  REQUIRE(humanoid->choose("humanoid").ok());
  ParamList list(arm->keys(), &*arm);
  const Param* shared = Scope(list, "lm").matrix("weight", 4, 2);
  const Param* own = Scope(list, "state_in").matrix("weight", 3, 4);
  CHECK(Scope(list, "lm").matrix("weight", 4, 2) == shared);
  CHECK(list.report("test", [](const std::string&) { return false; }).ok());
  ParamList next(*humanoid, list);
  CHECK(Scope(next, "policy").dim("max_views") == 2);
  CHECK(Scope(next, "lm").matrix("weight", 4, 2) == shared);
  const Param* other = Scope(next, "state_in").matrix("weight", 5, 4);
  CHECK(other != own);
  CHECK(other->source->data.front() == std::byte{3});
  CHECK(own->source->data.front() == std::byte{2});
  CHECK(list.params().size() == 3);
  CHECK(next.report("test", [](const std::string& tensor) { return tensor == "stats.x"; }).ok());
}

TEST_CASE("codes are shared together with their scale, or not at all") {
  EditableBundle bundle = two_robots();
  for (const char* name : {"a", "b"})
    bundle.tensors.push_back({name + std::string(".weight"), DType::i8, {1, 2}, "UU"});
  bundle.tensors.push_back({"a.scale", DType::f32, {1}, std::string(4, '\1')});
  for (const std::string& tag : kTags)
    bundle.tensors.push_back({"embodiment." + tag + ".b.scale", DType::f32, {1}, std::string(4, tag[0])});
  const std::string bytes = bundle.bytes();
  auto arm = parse(bytes), humanoid = parse(bytes);
  REQUIRE(arm->choose("arm").ok());
  REQUIRE(humanoid->choose("humanoid").ok());
  ParamList list(arm->keys(), &*arm);
  const Param *a = Scope(list, "a").ternary("weight", 4, 2), *b = Scope(list, "b").ternary("weight", 4, 2);
  ParamList next(*humanoid, list);
  CHECK(Scope(next, "a").ternary("weight", 4, 2) == a);
  const Param* own = Scope(next, "b").ternary("weight", 4, 2);
  CHECK(own != b);
  CHECK(own->scales->source->data.front() == std::byte{'h'});
  CHECK(b->scales->source->data.front() == std::byte{'a'});
  CHECK(next.report("test", [](const std::string& name) { return name[0] != 'a' && name[0] != 'b'; }).ok());
}

TEST_CASE("a tensor of a further robot that no module declares is refused, and so is a shape that does not fit") {
  const std::string bytes = two_robots().bytes();
  auto arm = parse(bytes), humanoid = parse(bytes);
  REQUIRE(arm->choose("arm").ok());
  REQUIRE(humanoid->choose("humanoid").ok());
  ParamList list(arm->keys(), &*arm);
  Scope(list, "lm").matrix("weight", 4, 2);
  Scope(list, "state_in").matrix("weight", 3, 4);
  ParamList next(*humanoid, list);
  Scope(next, "lm").matrix("weight", 2, 4);
  Scope(next, "state_in").matrix("weight", 5, 4);
  const Status report = next.report("test", [](const std::string&) { return false; });
  REQUIRE_FALSE(report.ok());
  CHECK(contains(report.error().message(), "unused tensor   stats.x"));
  CHECK(contains(report.error().message(), "wrong shape     lm.weight"));
}

}  // namespace embodiments_test
