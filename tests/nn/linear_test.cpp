// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Layers through the kernels of this machine against plain ggml operations on the same bundle.
#include "nn/linear.h"

#include <doctest/doctest.h>

#include <cmath>

#include "kernels/linear_kernel.h"
#include "kernels/norm.h"
#include "nn/tokens.h"
#include "support/editable_bundle.h"
#include "support/graph_runner.h"
#include "support/kernel_rows.h"

using namespace vla;
using test::ramp;

namespace {

constexpr int kModel = 35, kFf = 67;
constexpr int kFew = 29, kMany = 70;  // rows: tiles of bf16 take x of few more exactly, and round that of many once

/// Layers `a` and `b` of kModel to kFf and `c` back, with biases and weights in a storage type.
std::string make_bundle(DType type) {
  test::EditableBundle bundle;
  for (const char* key : {"vla.arch", "vla.source.name", "vla.source.revision", "vla.source.converter"})
    bundle.set(key, std::string("test"));
  bundle.set("vla.bundle_version", 1);
  bundle.set("vla.dtype", std::string(dtype_name(type)));
  const auto text = [](const auto& values) {
    return std::string(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(values[0]));
  };
  for (const char* name : {"a", "b", "c"}) {
    const std::int64_t d_in = *name == 'c' ? kFf : kModel, d_out = *name == 'c' ? kModel : kFf;
    std::vector<float> weight =
        ramp(static_cast<std::size_t>(d_in * d_out), 0.2f + 0.1f * static_cast<float>(*name - 'a'));
    std::vector<std::uint16_t> halves(weight.size());
    if (type == DType::bf16)
      ggml_fp32_to_bf16_row(weight.data(), reinterpret_cast<ggml_bf16_t*>(halves.data()), d_in * d_out);
    if (type == DType::f16) ggml_fp32_to_fp16_row(weight.data(), halves.data(), d_in * d_out);
    bundle.tensors.push_back(
        {std::string(name) + ".weight", type, {d_in, d_out}, type == DType::f32 ? text(weight) : text(halves)});
    bundle.tensors.push_back(
        {std::string(name) + ".bias", DType::f32, {d_out}, text(ramp(static_cast<std::size_t>(d_out), 1.0f))});
  }
  return bundle.bytes();
}

struct Layers {
  Linear a, b, c;
  explicit Layers(const Scope& s)
      : a(s / "a", kModel, kFf, Bias::yes), b(s / "b", kModel, kFf, Bias::yes), c(s / "c", kFf, kModel, Bias::yes) {}
};

/// What multiplies: the kernels of an instruction set, or another choice among them.
struct Row {
  std::string name;
  Isa isa;
  ChooseFormat choose;
};

const MatrixFormat* choose_emulated_tiles(const MatrixDesc& desc, Isa) {
  const kernels::LinearKernel* tiles = kernels::emulated_linear_kernels().back();
  return tiles->supports(desc, Isa::amx) ? tiles : nullptr;
}

std::vector<Row> rows() {
  std::vector<Row> all = {{"emulated_amx", Isa::ggml, choose_emulated_tiles}};
  for (Isa isa : usable_isas()) all.push_back({isa_name(isa), isa, kernels::choose_linear});
  return all;
}

/// What `build` makes of x [kModel, n_row]; `taps` are kept beside it.
std::vector<float> run(const Row& row, DType type, int n_row, const std::string& taps,
                       const std::function<Tensor(Graph&, const Layers&, Tensor)>& build) {
  const std::string bytes = make_bundle(type);
  const auto bundle = Bundle::parse(std::as_bytes(std::span(bytes)), "test");
  REQUIRE_MESSAGE(bundle.ok(), (bundle ? "" : bundle.error().message()));
  ParamList list(bundle->keys(), &*bundle);
  const Layers layers(Scope(list, ""));
  const Status fits = list.report("test", {});
  REQUIRE_MESSAGE(fits.ok(), (fits.ok() ? "" : fits.error().message()));
  const auto device = Device::cpu(3, isa_name(row.isa));
  REQUIRE(device.ok());
  const auto weights = Weights::load(list, *device, Weights::Fill::yes, row.choose);
  REQUIRE(weights.ok());
  Store store(64);
  const Tensor x = store.add_constant(ramp(static_cast<std::size_t>(kModel * n_row), 1.0f), {kModel, n_row});
  Graph graph(*weights, store, [&](const std::string& path) { return path == "result" || path == taps; });
  graph.name("result", build(graph, layers, x));
  ComputeMemory memory(*device);
  REQUIRE(store.allocate(*device).ok());
  REQUIRE(graph.reserve(memory).ok());
  REQUIRE(graph.allocate(memory).ok());
  REQUIRE(graph.run(*device).ok());
  for (const auto& [path, value] : graph.taps())
    if (path == "result") return Store::get(value);
  FAIL("no result");
  return {};
}

/// Every kernel of this machine and every storage type against widened weights and ggml; sums of at most 67 products
/// of numbers below 1 differ by their order alone.
void check_like_ggml(const std::function<Tensor(Graph&, const Layers&, Tensor)>& build) {
  for (DType type : {DType::bf16, DType::f16, DType::f32})
    for (const Row& row : rows())
      for (int n_row : {kFew, kMany})
        for (const char* tap : {"", "a", "c"}) {
          CAPTURE(row.name);
          CAPTURE(dtype_name(type));
          CAPTURE(n_row);
          CAPTURE(tap);
          const std::vector<float> expected = run({"ggml", Isa::ggml, nullptr}, type, n_row, "", build);
          const std::vector<float> got = run(row, type, n_row, tap, build);
          // Tiles round x to bf16: 2^-9 of each product, or 2^-17 for few rows.
          const bool tiles = type == DType::bf16 && row.name.find("amx") != std::string::npos;
          const double tolerance = !tiles ? 1e-5 : n_row == kMany ? 0.1 : 4e-4;
          double largest = 0;
          REQUIRE(got.size() == expected.size());
          for (std::size_t i = 0; i < got.size(); ++i)
            largest = std::max(largest, std::abs(double{got[i]} - expected[i]));
          CHECK(largest <= tolerance);
        }
}

}  // namespace

TEST_CASE("a layer gives what ggml's product of widened weights gives") {
  check_like_ggml([](Graph& g, const Layers& l, Tensor x) { return l.c(g, l.a(g, x)); });
}

TEST_CASE("an activation and a residual in the product's node change nothing, nor does a tap between them") {
  check_like_ggml([](Graph& g, const Layers& l, Tensor x) {
    return l.c.added_to(g, x, l.b.activated(g, l.c(g, l.a.activated(g, x, Activation::gelu_tanh)), Activation::silu));
  });
}

TEST_CASE("tokens cut out of several sequences are multiplied and added to as any x is") {
  check_like_ggml([](Graph& g, const Layers& l, Tensor x) {
    const int half = static_cast<int>(x.dim(1)) / 2;
    const Tensor two = ggml_reshape_3d(g.context(), slice_tokens(g, x, 0, 2 * half).node(), kModel, half, 2);
    const Tensor some = slice_tokens(g, two, 1, half - 1);
    return l.c.added_to(g, some, l.a.activated(g, some, Activation::gelu_erf));
  });
}

TEST_CASE("a gate in the product's node changes nothing, nor does a tap of the gate") {
  check_like_ggml(
      [](Graph& g, const Layers& l, Tensor x) { return l.c(g, Linear::gated(g, l.a, l.b, x, Activation::silu)); });
}

TEST_CASE("layers of one x as a group give what each gives alone") {
  check_like_ggml([](Graph& g, const Layers& l, Tensor x) {
    const std::vector<Tensor> both = Linear::group(g, {&l.a, &l.b}, x);
    return l.c(g, Tensor(ggml_sub(g.context(), both[0].node(), both[1].node())));
  });
}

Tensor normed(Graph& g, Tensor x, bool centred) {
  const Tensor weight = g.store().add_constant(ramp(kModel, 2), {kModel});
  if (!centred) return kernels::rms_norm(g, x, weight, {}, 1e-5f);
  return kernels::layer_norm(g, x, weight, g.store().add_constant(ramp(kModel, 1), {kModel}), 1e-5f);
}

TEST_CASE("a norm before products gives what the norm and the products give one after the other") {
  for (bool centred : {false, true})
    check_like_ggml([&](Graph& g, const Layers& l, Tensor x) {
      const Tensor h = normed(g, x, centred);
      return l.c(g, Linear::gated(g, l.a, l.b, h, Activation::silu));
    });
}

TEST_CASE("a norm that only products read is no node of its own" * doctest::skip(test::lacks(Isa::avx2))) {
  const auto n_node = [](bool with_reader) {
    int n = 0;
    run({"avx2", Isa::avx2, kernels::choose_linear}, DType::bf16, kFew, "", [&](Graph& g, const Layers& l, Tensor x) {
      const Tensor h = normed(g, x, true), y = l.a(g, h);
      if (with_reader) g.require(h);
      g.require(y);
      n = g.n_node();
      return l.c(g, y);
    });
    return n;
  };
  CHECK(n_node(false) == 1);
  CHECK(n_node(true) == 2);
}
