// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// What may be recorded, and what a graph says of what does not fit.
#include "devices/devices.h"
#include "graph/cache.h"

#include <doctest/doctest.h>

namespace graph_test {

using namespace vla;

namespace {

Param param(Storage storage, std::vector<std::int64_t> shape) {
  return {.name = "p", .storage = storage, .shape = std::move(shape)};
}

struct Fixture {
  Slots slots;
  Graph g{slots};
  Tensor f32(const Shape& shape) { return g.input(slots.add_f32(shape)); }
  Tensor i32(const Shape& shape) { return g.input(slots.add_i32(shape)); }

  void accepts(Op op, std::vector<Tensor> in, const Shape& result, const Shape& asked = {}) {
    const Tensor y = g.add(std::move(op), std::move(in), asked);
    CHECK(g.problem() == "");
    CHECK(y.shape() == result);
  }
  /// In a graph of its own, since a graph tells its first problem alone.
  void refuses(Op op, std::vector<Tensor> in, const Shape& asked = {}) {
    Graph other(slots);
    const std::string name = op_name(op);
    other.add(std::move(op), std::move(in), asked);
    CAPTURE(name);
    CHECK(other.problem().find(name) == 0);
  }
};

}  // namespace

TEST_CASE_FIXTURE(Fixture, "products take x of their depth, and look-ups take ids") {
  const Param weight = param(Storage::matrix, {4, 7}), bias = param(Storage::vector, {7}),
              wrong = param(Storage::vector, {4}), table = param(Storage::table, {4, 9});
  accepts(op::Linear{&weight, &bias}, {f32({4, 3, 2, 1})}, {7, 3, 2, 1});
  accepts(op::Linear{&weight, nullptr}, {f32({4, 1, 1, 1})}, {7, 1, 1, 1});
  refuses(op::Linear{&weight, &bias}, {f32({5, 3, 1, 1})});
  refuses(op::Linear{&weight, &wrong}, {f32({4, 3, 1, 1})});
  refuses(op::Linear{&weight, &bias}, {i32({4, 1, 1, 1})});
  refuses(op::Linear{&weight, &bias}, {Tensor()});
  Param ternary = weight;
  ternary.encoding = {DType::ternary, 28};
  accepts(op::Linear{&ternary, &bias, op::Rule::int8_rows}, {f32({4, 3, 1, 1})}, {7, 3, 1, 1});
  refuses(op::Linear{&ternary, &bias, op::Rule::floats}, {f32({4, 3, 1, 1})});
  refuses(op::Linear{&weight, &bias, op::Rule::int8_rows}, {f32({4, 3, 1, 1})});
  accepts(op::Embedding{&table}, {i32({3, 1, 1, 1})}, {4, 3, 1, 1});
  refuses(op::Embedding{&weight}, {i32({3, 1, 1, 1})});
  refuses(op::Embedding{&table}, {f32({3, 1, 1, 1})});
  refuses(op::Embedding{&table}, {i32({3, 2, 1, 1})});
  accepts(op::Gather{}, {f32({4, 9, 1, 1}), i32({3, 1, 1, 1})}, {4, 3, 1, 1});
  accepts(op::Gather{}, {i32({1, 9, 1, 1}), i32({1, 1, 1, 1})}, {1, 1, 1, 1});
  refuses(op::Gather{}, {f32({4, 9, 2, 1}), i32({3, 1, 1, 1})});
  accepts(op::Parameter{&bias}, {}, {7, 1, 1, 1}, {7, 1, 1, 1});
  refuses(op::Parameter{&weight}, {}, {4, 7, 1, 1});
}

TEST_CASE_FIXTURE(Fixture,
                  "norms take vectors of the width of a row, and rotations one angle for each pair and token") {
  const Tensor x = f32({6, 2, 5, 3}), w = f32({6, 1, 1, 1});
  const op::Norm norm = {op::NormKind::layer, 1e-5f};
  accepts(norm, {x}, x.shape());
  accepts(norm, {x, w}, x.shape());
  accepts(norm, {x, w, w}, x.shape());
  refuses(norm, {x, f32({5, 1, 1, 1})});
  refuses(norm, {x, f32({6, 2, 1, 1})});
  refuses(norm, {});
  accepts(op::Rope{}, {x, f32({6, 5, 1, 1})}, x.shape());
  refuses(op::Rope{}, {x, f32({6, 2, 1, 1})});
  refuses(op::Rope{}, {f32({5, 2, 3, 1}), f32({5, 3, 1, 1})});
}

TEST_CASE_FIXTURE(Fixture, "attention takes segments of keys and values in turn, and a mask over all of them") {
  const Tensor q = f32({8, 6, 5, 2}), k = f32({8, 2, 3, 2}), more = f32({8, 2, 4, 2});
  accepts(op::Attention{false}, {q, k, k}, {48, 5, 2, 1});
  accepts(op::Attention{true}, {q, f32({7, 5, 1, 1}), k, k, more, more}, {48, 5, 2, 1});
  refuses(op::Attention{false}, {q, k});
  refuses(op::Attention{false}, {q, k, more});
  refuses(op::Attention{true}, {q, f32({7, 5, 1, 1}), k, k});
  refuses(op::Attention{false}, {q, f32({8, 4, 3, 2}), f32({8, 4, 3, 2})});
  refuses(op::Attention{false}, {q, f32({7, 2, 3, 2}), f32({7, 2, 3, 2})});
  refuses(op::Attention{false}, {q, f32({8, 2, 3, 1}), f32({8, 2, 3, 1})});
}

TEST_CASE_FIXTURE(Fixture, "a second operand counts for all where it has 1") {
  const Tensor a = f32({3, 4, 2, 1});
  for (const Shape& shape : {Shape{3, 4, 2, 1}, Shape{3, 1, 1, 1}, Shape{1, 4, 1, 1}, Shape{1, 1, 1, 1}}) {
    accepts(op::Add{}, {a, f32(shape)}, a.shape());
    accepts(op::Multiply{}, {a, f32(shape)}, a.shape());
  }
  for (const Shape& shape : {Shape{3, 2, 2, 1}, Shape{3, 4, 2, 2}, Shape{6, 4, 2, 1}}) {
    refuses(op::Add{}, {a, f32(shape)});
    refuses(op::Multiply{}, {a, f32(shape)});
  }
  accepts(op::Scale{2}, {a}, a.shape());
  accepts(op::Activate{Activation::silu}, {a}, a.shape());
  refuses(op::Scale{2}, {i32({3, 1, 1, 1})});
  refuses(op::Activate{Activation::silu}, {a, a});
}

TEST_CASE_FIXTURE(Fixture, "parts are joined and cut along one dimension") {
  const Tensor a = f32({3, 4, 2, 1}), b = f32({3, 5, 2, 1});
  accepts(op::Concat{1}, {a, b, a}, {3, 13, 2, 1});
  refuses(op::Concat{0}, {a, b});
  refuses(op::Concat{4}, {a, a});
  accepts(op::Slice{1, 2}, {b}, {3, 3, 2, 1}, {3, 3, 2, 1});
  accepts(op::Slice{0, 1}, {i32({3, 1, 1, 1})}, {2, 1, 1, 1}, {2, 1, 1, 1});
  refuses(op::Slice{1, 3}, {b}, {3, 3, 2, 1});
  refuses(op::Slice{1, -1}, {b}, {3, 3, 2, 1});
  refuses(op::Slice{1, 0}, {b}, {2, 3, 2, 1});
  accepts(op::Repeat{}, {f32({3, 1, 1, 1})}, {3, 4, 2, 1}, {3, 4, 2, 1});
  refuses(op::Repeat{}, {a}, {3, 8, 2, 1});
  accepts(op::Reshape{}, {a}, {12, 2, 1, 1}, {12, 2, 1, 1});
  refuses(op::Reshape{}, {a}, {12, 3, 1, 1});
  accepts(op::Permute{{2, 0, 3, 1}}, {a}, {2, 3, 1, 4});
  refuses(op::Permute{{2, 0, 2, 1}}, {a});
  refuses(op::Permute{{1, 2, 3, 4}}, {a});
}

TEST_CASE_FIXTURE(Fixture, "features attend to those of their group, of which each has at most 64") {
  const Tensor x = f32({12, 5, 2, 1});
  accepts(op::ChannelAttention{3}, {x, x, x}, x.shape());
  refuses(op::ChannelAttention{5}, {x, x, x});
  refuses(op::ChannelAttention{0}, {x, x, x});
  refuses(op::ChannelAttention{3}, {x, x});
  refuses(op::ChannelAttention{3}, {x, f32({12, 4, 2, 1}), x});
  const Tensor wide = f32({130, 5, 1, 1});
  accepts(op::ChannelAttention{5}, {wide, wide, wide}, wide.shape());
  refuses(op::ChannelAttention{2}, {wide, wide, wide});
}

TEST_CASE_FIXTURE(Fixture, "images are cut into whole patches, and patches joined in whole squares") {
  accepts(op::Patches{4}, {f32({9, 13, 3, 2})}, {48, 6, 2, 1});  // what is left of a patch is dropped
  refuses(op::Patches{4}, {f32({3, 8, 3, 1})});
  refuses(op::Patches{4}, {f32({8, 8, 1, 1})});
  accepts(op::Unfold{{3, 2, 1}}, {f32({5, 9, 14, 2})}, {45, 5, 7, 2});
  accepts(op::Unfold{{7, 2, 3}}, {f32({3, 1, 2, 1})}, {147, 1, 1, 1});
  refuses(op::Unfold{{4, 1, 0}}, {f32({5, 3, 9, 1})});  // no place along the first side
  refuses(op::Unfold{{0, 1, 0}}, {f32({5, 9, 9, 1})});
  refuses(op::Unfold{{3, 0, 0}}, {f32({5, 9, 9, 1})});
  refuses(op::Unfold{{3, 1, -1}}, {f32({5, 9, 9, 1})});
  accepts(op::MaxPool{{3, 2, 1}}, {f32({5, 9, 14, 2})}, {5, 5, 7, 2});
  refuses(op::MaxPool{{3, 2, 2}}, {f32({5, 9, 14, 2})});  // a window of no pixel
  accepts(op::Depthwise{{3, 2, 1}}, {f32({5, 9, 14, 2}), f32({45, 1, 1, 1}), f32({5, 1, 1, 1})}, {5, 5, 7, 2});
  refuses(op::Depthwise{{3, 2, 1}}, {f32({5, 9, 14, 2}), f32({44, 1, 1, 1}), f32({5, 1, 1, 1})});
  refuses(op::Depthwise{{3, 2, 1}}, {f32({5, 9, 14, 2}), f32({45, 1, 1, 1}), f32({1, 1, 1, 1})});
  refuses(op::Depthwise{{3, 2, 1}}, {f32({5, 9, 14, 2}), f32({45, 1, 1, 1})});
  accepts(op::PixelShuffle{6, 2}, {f32({3, 24, 2, 1})}, {12, 6, 2, 1});
  refuses(op::PixelShuffle{5, 2}, {f32({3, 20, 2, 1})});
  refuses(op::PixelShuffle{6, 2}, {f32({3, 18, 2, 1})});
}

TEST_CASE_FIXTURE(Fixture, "a slot takes what has its shape and dtype") {
  accepts(op::Write{slots.add_f32({3, 4, 1, 1})}, {f32({3, 4, 1, 1})}, {3, 4, 1, 1});
  refuses(op::Write{slots.add_f32({4, 3, 1, 1})}, {f32({3, 4, 1, 1})});
  refuses(op::Write{slots.add_i32({3, 1, 1, 1})}, {f32({3, 1, 1, 1})});
}

TEST_CASE_FIXTURE(Fixture, "the first problem is told with its operands, and a device refuses the graph") {
  const Tensor a = f32({3, 4, 1, 1}), b = f32({5, 1, 1, 1});
  g.add(op::Add{}, {a, b});
  g.add(op::Multiply{}, {a, Tensor()});
  CHECK(g.problem() == "add 2 of [3, 4], [5]: operands do not fit");
  for (const char* kernels : {"ggml", ""}) {
    const auto device = open_device(1, kernels);
    REQUIRE(device.ok());
    REQUIRE((*device)->load(ParamList(Keys(), nullptr), true).ok());
    REQUIRE((*device)->allocate(slots).ok());
    const auto program = (*device)->lower(g);
    REQUIRE_FALSE(program.ok());
    CHECK(program.error().code == Code::internal);
    CHECK(program.error().message().find("add 2 of [3, 4], [5]") != std::string::npos);
  }
}

TEST_CASE_FIXTURE(Fixture, "leaves and constants of one key are made once") {
  const Slot* slot = slots.add_f32({2, 1, 1, 1});
  CHECK(g.input(slot) == g.input(slot));
  int n_made = 0;
  const auto make = [&] {
    ++n_made;
    return std::vector<float>{1, 2};
  };
  CHECK(g.constant("k", {2, 1, 1, 1}, make) == g.constant("k", {2, 1, 1, 1}, make));
  CHECK(n_made == 1);
  const auto ids = [] { return std::vector<std::int32_t>{1, 2}; };
  CHECK_FALSE(g.constant_ids("k", ids) == g.constant("k", {2, 1, 1, 1}, make));
  CHECK(n_made == 1);
}

TEST_CASE("a value keeps its first path, and where a filter wants both each has its own") {
  Slots slots;
  Graph g(slots, [](const std::string& path) { return path != "dull"; });
  const Tensor x = g.input(slots.add_f32({2, 1, 1, 1})), y = g.add(op::Scale{2}, {x});
  CHECK(g.name("inner", y) == y);
  CHECK(g.name("outer", y) == y);
  g.name("dull", y);
  g.name("input", x);
  std::vector<std::string> tapped;
  for (const Node& node : g.nodes())
    if (node.tapped) tapped.push_back(node.path);
  CHECK(tapped == std::vector<std::string>{"inner", "outer", "input"});
  CHECK(y.node()->path == "inner");
}

TEST_CASE("what one graph leaves in the cache is the value itself there, and an input elsewhere") {
  Slots slots;
  Graph first(slots), second(slots);
  Cache cache;
  const Tensor y = first.add(op::Scale{2}, {first.input(slots.add_f32({2, 3, 1, 1}))});
  cache.put(first, "y", y);
  CHECK(cache.has("y"));
  CHECK_FALSE(cache.has("z"));
  CHECK(cache.get(first, "y") == y);
  const Tensor got = cache.get(second, "y");
  CHECK(got.shape() == y.shape());
  CHECK(got.node()->as<op::Input>() != nullptr);
}

}  // namespace graph_test
