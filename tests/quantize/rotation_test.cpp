// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Channels that are rotated together where they are made and where they are read.
#include "quantize/rotation.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <cstring>

#include "quantize/ones.h"
#include "quantize/rotation_places.h"
#include "quantize/rotator.h"
#include "support/editable_bundle.h"
#include "support/golden_case.h"

namespace rotation_test {

using namespace vla;
using namespace vla::test;

namespace {

constexpr int kWidth = 32;

/// Graphs over a residual stream: `first` makes it, blocks add to it behind norms, and `last` reads it.
struct Stream {
  Stream() {
    const Scope s = set.scope();
    for (const char* name : {"norm", "bias", "gain"}) vectors[name] = s.vector(name, kWidth);
    for (const char* name : {"first", "up", "down", "last"}) matrices[name] = s.matrix(name, kWidth, kWidth);
    image = g.input(slots.add_f32({kWidth, 4, 1, 1}));
  }
  Tensor product(const char* matrix, Tensor of, const Param* bias = nullptr) {
    return g.add(op::Linear{matrices.at(matrix), bias}, {of});
  }
  Tensor parameter(const char* name) { return g.parameter(vectors.at(name)); }
  Tensor norm(Tensor of) {
    return g.name("lm.norm", g.add(op::Norm{op::NormKind::layer, 1e-5f}, {of, parameter("norm"), parameter("bias")}));
  }
  Tensor activate(Tensor of) { return g.add(op::Activate{Activation::silu}, {of}); }
  Tensor add(Tensor a, Tensor b) { return g.add(op::Add{}, {a, b}); }
  /// What the whole network returns is read by the caller.
  void end(Tensor stream) { g.write(activate(product("last", stream)), slots.add_f32(stream.shape())); }

  std::vector<RotationPlace> found() {
    RotationPlaces finder;
    finder.see(g);
    return finder.found();
  }
  std::vector<std::string> names(const std::set<const Param*>& params) {
    std::vector<std::string> names;
    for (const Param* param : params) names.push_back(param->name);
    std::ranges::sort(names);
    return names;
  }

  ParamSet set{ones(kWidth, {"first", "up", "down", "last"}, {"norm", "bias", "gain"})};
  std::map<std::string, const Param*> vectors, matrices;
  Slots slots;
  Graph g{slots};
  Tensor image;
};

using Names = std::vector<std::string>;

/// The same bundle with float32 in the place of bf16.
std::string in_float32(const std::string& path) {
  EditableBundle bundle = EditableBundle::read(path);
  for (EditableBundle::Piece& piece : bundle.tensors) {
    if (piece.type != DType::bf16) continue;
    std::string floats(2 * piece.data.size(), '\0');
    const char *from = piece.data.data(), *const end = from + piece.data.size();
    for (char* to = floats.data() + 2; from != end; from += 2, to += 4) std::memcpy(to, from, 2);
    piece.type = DType::f32, piece.data = std::move(floats);
  }
  return bundle.write("float32.gguf");
}

template <class T>
double relative_difference(const std::vector<T>& got, const std::vector<T>& expected) {
  double off = 0, largest = 0;
  for (std::size_t i = 0; i < expected.size(); ++i) {
    off = std::max(off, std::abs(double{got.at(i)} - double{expected[i]}));
    largest = std::max(largest, std::abs(double{expected[i]}));
  }
  return off / largest;
}

}  // namespace

TEST_CASE("the rotator is orthogonal, its own inverse, spreads a channel and leaves equal channels as they are") {
  for (const std::int64_t d : {32, 48, 45, 720, 1152}) {
    CAPTURE(d);
    Rotator rotator(d);
    REQUIRE(rotator.d() == d);
    constexpr std::int64_t kColumns = 3;  // a unit vector, ones, and what has all sizes
    std::vector<double> x(static_cast<std::size_t>(d * kColumns));
    for (std::int64_t i = 0; i < d; ++i) {
      double* const row = &x[static_cast<std::size_t>(i * kColumns)];
      row[0] = i == d / 3 ? 1 : 0, row[1] = 1, row[2] = std::sin(static_cast<double>(i * i));
    }
    const std::vector<double> before = x;
    rotator.rotate(x.data(), kColumns);
    double square = 0, largest = 0, ones = 0, moved = 0;
    for (std::size_t i = 0; i < x.size(); i += kColumns) {
      square += x[i] * x[i], largest = std::max(largest, std::abs(x[i]));
      ones = std::max(ones, std::abs(x[i + 1] - 1));
      moved = std::max(moved, std::abs(x[i + 2] - before[i + 2]));
    }
    CHECK(square == doctest::Approx(1).epsilon(1e-12));
    CHECK(largest < 6 / std::sqrt(static_cast<double>(d)));
    CHECK(ones < 1e-12);
    CHECK(moved > 0.1);
    rotator.rotate(x.data(), kColumns);
    double off = 0;
    for (std::size_t i = 0; i < x.size(); ++i) off = std::max(off, std::abs(x[i] - before[i]));
    CHECK(off < 1e-12);
  }
}

TEST_CASE("a residual stream that only norms before matrices read is rotated, with all that makes and reads it") {
  Stream p;
  Tensor x = p.product("first", p.image);
  x = p.add(x, p.product("down", p.activate(p.product("up", p.norm(x)))));
  p.end(x);
  const auto found = p.found();
  REQUIRE(found.size() == 1);
  CHECK(found[0].path == "lm.norm");
  CHECK_FALSE(found[0].is_heads);
  CHECK(found[0].d == kWidth);
  CHECK(p.names(found[0].rows) == Names{"down", "first"});
  CHECK(p.names(found[0].elements) == Names{"bias", "last", "up"});
  REQUIRE(found[0].folded.size() == 1);
  CHECK(found[0].folded[0].gain->name == "norm");
  CHECK(found[0].folded[0].bias->name == "bias");
  CHECK(p.names(found[0].folded[0].columns) == Names{"up"});
}

TEST_CASE("a gain of a product that the stream adds goes into the product") {
  Stream p;
  Tensor x = p.product("first", p.image);
  const Tensor y = p.product("down", p.activate(p.product("up", p.norm(x))));
  x = p.add(x, p.g.add(op::Multiply{}, {y, p.parameter("gain")}));
  p.end(x);
  const auto found = p.found();
  REQUIRE(found.size() == 1);
  REQUIRE(found[0].folded.size() == 2);
  const auto folded = std::ranges::find(found[0].folded, p.vectors["gain"], &FoldedGain::gain);
  REQUIRE(folded != found[0].folded.end());
  CHECK(p.names(folded->rows) == Names{"down"});
}

TEST_CASE("a stream is left as it is where") {
  Stream p;
  const Tensor x = p.product("first", p.image);
  SUBCASE("an activation sees its channels") { p.end(p.activate(x)); }
  SUBCASE("the image is added") { p.end(p.add(x, p.image)); }
  SUBCASE("a constant is added") { p.end(p.add(x, p.g.constant(std::vector<float>(kWidth, 1), {kWidth, 1, 1, 1}))); }
  SUBCASE("the caller sees it") {
    p.end(x);
    p.g.write(x, p.slots.add_f32(x.shape()));
  }
  SUBCASE("the caller fills what is added") {
    Slot* const slot = p.slots.add_f32(x.shape());
    const Tensor sum = p.add(x, p.g.input(slot));
    p.end(sum);
    p.g.write(sum, slot);
  }
  SUBCASE("a norm is read by the stream") { p.end(p.add(x, p.norm(x))); }
  SUBCASE("a matrix reads something else too") {
    p.end(p.product("up", p.norm(x)));
    p.product("up", p.activate(p.image));
    p.end(p.product("up", p.activate(p.image)));
  }
  SUBCASE("a norm's weight has another reader") {
    p.end(p.product("up", p.norm(x)));
    p.end(p.activate(p.add(p.product("down", p.activate(p.image)), p.parameter("norm"))));
  }
  SUBCASE("a gain multiplies another value too") {
    p.g.add(op::Multiply{}, {p.activate(p.image), p.parameter("gain")});
    p.end(p.g.add(op::Multiply{}, {x, p.parameter("gain")}));
  }
  for (const RotationPlace& place : p.found()) CHECK_FALSE(place.rows.contains(p.matrices["first"]));
}

TEST_CASE("the values of attention heads are rotated head by head, also where another graph reads them") {
  constexpr int kHead = 16;
  Stream p;
  const auto heads = [](Graph& g, Tensor x) { return g.add(op::Reshape{}, {x}, {kHead, kWidth / kHead, 4, 1}); };
  const Tensor q = heads(p.g, p.product("up", p.activate(p.image)));
  const Tensor v = heads(p.g, p.product("first", p.activate(p.image)));
  Slot* const cached = p.slots.add_f32(v.shape());
  p.g.write(v, cached);
  const Tensor out = p.product("down", p.g.add(op::Attention{false}, {q, q, v}));
  p.g.write(p.activate(out), p.slots.add_f32(out.shape()));
  RotationPlaces finder;
  finder.see(p.g);
  CHECK(finder.found().empty());  // nobody reads what was stored: the caller may
  Graph step(p.slots);
  const Tensor asked =
      heads(step, step.add(op::Activate{Activation::silu}, {step.input(p.image.node()->as<op::Input>()->slot)}));
  step.add(op::Linear{p.matrices["last"], nullptr},
           {step.add(op::Attention{false}, {asked, asked, step.input(cached)})});
  finder.see(step);
  const auto found = finder.found();
  REQUIRE(found.size() == 1);
  CHECK(found[0].is_heads);
  CHECK(found[0].d == kHead);
  CHECK(p.names(found[0].rows) == Names{"first"});
  CHECK(p.names(found[0].elements) == Names{"down", "last"});
}

TEST_CASE("a rotated policy of float32 acts as before, within 1e-6 of its largest number") {
  int n_rotated = 0;
  const std::vector<std::string> names = golden_paths();
  for (std::size_t i = 0; i < names.size(); i += 3) {
    CAPTURE(names[i]);
    const GoldenCase golden = GoldenCase::read(names[i]);
    const std::string floats = in_float32(golden.bundle()), rotated = write_file("rotated.gguf", "");
    const auto found = find_rotations(floats, {.n_thread = 1, .all_robots = true});
    REQUIRE(found.ok());
    n_rotated += !found->empty();
    std::vector<Rotation> all;
    for (const auto& [name, rotations] : *found) all.insert(all.end(), rotations.begin(), rotations.end());
    REQUIRE(write_rotated(floats, rotated, all).ok());
    const auto before = load_engine(floats, "", "float32"), after = load_engine(rotated, "", "float32");
    const auto expected = before->act(golden.observation, golden.noise);
    const auto got = after->act(golden.observation, golden.noise);
    REQUIRE(expected.ok());
    REQUIRE(got.ok());
    CHECK(relative_difference(got->actions, expected->actions) < 4e-6);
  }
  CHECK(n_rotated > 10);
}

}  // namespace rotation_test
