// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Every operation of graph/op.h on awkward shapes and strides, lowered for the CPU and as plain ggml operations.
#include "lower_case.h"

namespace ops_test {

using namespace vla;
using namespace vla::test;

namespace {

constexpr Activation kActivations[] = {Activation::gelu_tanh, Activation::gelu_erf,     Activation::silu,
                                       Activation::relu,      Activation::relu_squared, Activation::mish};

/// Contiguous, and a part of something wider.
constexpr Tensor (*kOperands[])(GraphRunner&, const Shape&, float) = {input, strided};

Tensor norm(Graph& g, op::NormKind kind, std::vector<Tensor> in) { return g.add(op::Norm{kind, 1e-5f}, std::move(in)); }

}  // namespace

TEST_CASE("activations, multiples, sums and products of any strides") {
  const Shape shape = {13, 5, 3, 2};
  for (const auto operand : kOperands) {
    for (const Activation activation : kActivations)
      check_like_ggml(
          [&](GraphRunner& r, const LowerParams&) { return activate(r.graph, operand(r, shape, 3), activation); });
    check_like_ggml([&](GraphRunner& r, const LowerParams&) { return scale(r.graph, operand(r, shape, 3), -1.5f); });
    for (const auto other : kOperands)
      for (const Shape& second : {shape, Shape{13, 1, 1, 1}, Shape{13, 5, 1, 1}, Shape{13, 1, 3, 2}, Shape{1, 5, 1, 1},
                                  Shape{1, 5, 3, 2}, Shape{1, 1, 1, 1}}) {
        CAPTURE(shape_text(second));
        check_like_ggml([&](GraphRunner& r, const LowerParams&) {
          const Tensor a = operand(r, shape, 3), b = other(r, second, 2);
          return multiply(r.graph, add(r.graph, a, b), b);
        });
      }
  }
}

TEST_CASE("norms of any strides, with and without weights") {
  for (const auto operand : kOperands)
    for (const op::NormKind kind : {op::NormKind::layer, op::NormKind::rms})
      for (const int n_vector : {0, 1, 2})
        check_like_ggml([&](GraphRunner& r, const LowerParams& p) {
          std::vector<Tensor> in = {operand(r, {35, 5, 3, 2}, 3)};
          if (n_vector > 0) in.push_back(p.parameter(r.graph, 35));
          if (n_vector > 1) in.push_back(slice_features(r.graph, p.parameter(r.graph, 67), 3, 35));
          return scale(r.graph, norm(r.graph, kind, in), 2);
        });
}

TEST_CASE("vectors that do not lie one number after the other") {
  const auto column = [](GraphRunner& r, int d) {  // of a matrix with rows of three
    return reshape(r.graph, slice(r.graph, input(r, {3, d, 1, 1}), 0, 1, 1), {d, 1, 1, 1});
  };
  check_like_ggml([&](GraphRunner& r, const LowerParams&) {
    return norm(r.graph, op::NormKind::layer, {input(r, {35, 4, 1, 1}), column(r, 35), column(r, 35)});
  });
  check_like_ggml([&](GraphRunner& r, const LowerParams& p) {  // before a product, and behind it
    const Tensor h = norm(r.graph, op::NormKind::rms, {input(r, {35, 4, 1, 1}), column(r, 35)});
    return multiply(r.graph, p.linear(r.graph, h, 67), column(r, 67));
  });
  check_like_ggml([&](GraphRunner& r, const LowerParams&) { return scale(r.graph, column(r, 12), 3); });
  check_like_ggml([&](GraphRunner& r, const LowerParams&) {
    return add(r.graph, scale(r.graph, input(r, {12, 4, 1, 1}), 3), column(r, 12));
  });
  check_like_ggml([&](GraphRunner& r, const LowerParams&) {  // the same number in every place of a row
    const Tensor wide = r.graph.add(op::Repeat{}, {input(r, {1, 4, 1, 1})}, {12, 4, 1, 1});
    return activate(r.graph, wide, Activation::silu);
  });
}

TEST_CASE("rotations of any strides, batches and tables") {
  for (const auto operand : kOperands)
    for (const int d_head : {2, 6, 34, 64})
      check_like_ggml([&](GraphRunner& r, const LowerParams&) {
        const Tensor x = operand(r, {d_head, 3, 5, 2}, 1);
        return r.graph.add(op::Rope{}, {x, input(r, {d_head, 5, 1, 1})});
      });
  check_like_ggml([&](GraphRunner& r, const LowerParams&) {  // a part of a longer and wider table
    return r.graph.add(op::Rope{}, {input(r, {6, 3, 5, 2}), strided(r, {6, 5, 1, 1})});
  });
}

TEST_CASE("parts are joined along any dimension, and cut again") {
  const Shape shape = {5, 4, 3, 2};
  for (const int dim : {0, 1, 2, 3})
    for (const auto operand : kOperands)
      check_like_ggml([&](GraphRunner& r, const LowerParams&) {
        Shape other = shape;
        other[static_cast<std::size_t>(dim)] = 7;
        const Tensor all = concat(r.graph, {operand(r, shape, 1), operand(r, other, 1), operand(r, shape, 1)}, dim);
        return slice(r.graph, all, dim, 1, 9);
      });
}

TEST_CASE("views of views in every shape that holds as many numbers") {
  for (const Shape& to : {Shape{6, 20, 1, 1}, Shape{2, 3, 20, 1}, Shape{24, 5, 1, 1}, Shape{120, 1, 1, 1},
                          Shape{1, 6, 4, 5}, Shape{12, 2, 5, 1}, Shape{5, 24, 1, 1}})
    for (const auto operand : kOperands) {
      CAPTURE(shape_text(to));
      check_like_ggml([&](GraphRunner& r, const LowerParams&) {
        return scale(r.graph, reshape(r.graph, operand(r, {6, 4, 5, 1}, 1), to), 2);
      });
      check_like_ggml([&](GraphRunner& r, const LowerParams&) {
        return reshape(r.graph, operand(r, {6, 4, 5, 1}, 1), to);
      });
    }
  for (const Shape& from : {Shape{6, 1, 1, 1}, Shape{6, 1, 5, 1}, Shape{1, 4, 1, 1}, Shape{1, 1, 1, 1}})
    check_like_ggml([&](GraphRunner& r, const LowerParams&) {
      return scale(r.graph, r.graph.add(op::Repeat{}, {input(r, from)}, {6, 4, 5, 1}), 2);
    });
}

TEST_CASE("dimensions in another order, for every reader") {
  for (const std::array<int, 4>& order :
       {std::array{0, 2, 1, 3}, std::array{1, 0, 2, 3}, std::array{3, 1, 0, 2}, std::array{2, 3, 1, 0}})
    for (const auto operand : kOperands) {
      const auto moved = [&](GraphRunner& r) { return r.graph.add(op::Permute{order}, {operand(r, {6, 4, 5, 2}, 1)}); };
      check_like_ggml([&](GraphRunner& r, const LowerParams&) { return moved(r); });
      check_like_ggml([&](GraphRunner& r, const LowerParams&) { return scale(r.graph, moved(r), 2); });
      check_like_ggml([&](GraphRunner& r, const LowerParams&) {
        return norm(r.graph, op::NormKind::layer, {reshape(r.graph, moved(r), {60, 4, 1, 1})});
      });
      check_like_ggml([&](GraphRunner& r, const LowerParams&) {
        return slice(r.graph, concat(r.graph, {moved(r), moved(r)}, 1), 1, 1, 2);
      });
      check_like_ggml([&](GraphRunner& r, const LowerParams& p) {
        return p.linear(r.graph, reshape(r.graph, moved(r), {24, 10, 1, 1}), 48);
      });
    }
}

TEST_CASE("rows of tables by ids, of which some are cut off") {
  const std::vector<std::int32_t> ids = {4, 0, 8, 4, 7, 1};
  const auto some = [&](Graph& g) { return slice(g, g.constant_ids("ids", [&] { return ids; }), 0, 1, 4); };
  for (const DType type : {DType::f32, DType::bf16, DType::f16}) {
    const LowerParams params(type);
    const auto build = [&](GraphRunner& r, const LowerParams& p) {
      return r.graph.add(op::Embedding{p.table()}, {some(r.graph)});
    };
    const auto expected = result_of("ggml", params, build);
    for (const KernelSet& set : lowered_kernels()) CHECK(result_of(name_of(set), params, build) == expected);
  }
  for (const auto operand : kOperands)
    check_like_ggml([&](GraphRunner& r, const LowerParams&) {
      return r.graph.add(op::Gather{}, {operand(r, {5, 9, 1, 1}, 1), some(r.graph)});
    });
}

TEST_CASE("patches of several views whose sides a patch need not divide, and squares of them") {
  for (const auto operand : kOperands) {
    for (const Shape& images : {Shape{8, 8, 3, 2}, Shape{9, 14, 3, 1}, Shape{4, 12, 3, 3}})
      check_like_ggml(
          [&](GraphRunner& r, const LowerParams&) { return r.graph.add(op::Patches{4}, {operand(r, images, 1)}); });
    for (const auto& [n, n_column, factor] : {std::array{24, 6, 2}, std::array{54, 6, 3}, std::array{16, 4, 4}})
      check_like_ggml([&](GraphRunner& r, const LowerParams&) {
        return pixel_shuffle(r.graph, operand(r, {5, n, 2, 1}, 1), n_column, factor);
      });
  }
}

TEST_CASE("windows over images, of every size, stride and padding that a convolution has") {
  const op::Window windows[] = {{7, 2, 3}, {3, 1, 1}, {3, 2, 1}, {1, 2, 0}, {1, 1, 0}, {2, 1, 0}, {5, 3, 4}};
  for (const auto operand : kOperands)
    for (const Shape& images : {Shape{3, 11, 6, 2}, Shape{35, 4, 5, 1}, Shape{1, 1, 3, 1}})
      for (const op::Window& window : windows) {
        if (images[1] + 2 * window.padding < window.size) continue;
        CAPTURE(shape_text(images));
        CAPTURE(window.size);
        CAPTURE(window.stride);
        check_like_ggml([&](GraphRunner& r, const LowerParams&) {
          return r.graph.add(op::Unfold{window}, {operand(r, images, 1)});
        });
        check_like_ggml([&](GraphRunner& r, const LowerParams&) {
          const Tensor weight = operand(r, {images[0] * window.size * window.size, 1, 1, 1}, 2);
          return r.graph.add(op::Depthwise{window},
                             {operand(r, images, 1), weight, operand(r, {images[0], 1, 1, 1}, 3)});
        });
        if (2 * window.padding > window.size) continue;
        check_like_ggml([&](GraphRunner& r, const LowerParams&) {
          return r.graph.add(op::MaxPool{window}, {operand(r, images, 1)});
        });
      }
}

TEST_CASE("attention of features to those of their group, of every width and number of tokens") {
  for (const auto operand : kOperands)
    for (const auto& [shape, n_group] : {std::pair(Shape{12, 7, 2, 1}, 3),
                                         {Shape{35, 130, 1, 1}, 1},
                                         {Shape{6, 1, 3, 1}, 6},
                                         {Shape{128, 65, 2, 1}, 2},
                                         {Shape{64, 49, 1, 1}, 2}}) {
      CAPTURE(shape_text(shape));
      check_like_ggml([&, n = n_group, of = shape](GraphRunner& r, const LowerParams&) {
        const Tensor q = operand(r, of, 1), k = operand(r, of, 2);
        return r.graph.add(op::ChannelAttention{n}, {q, k, operand(r, of, 3)});
      });
    }
}

TEST_CASE("the largest of a window has no zeros from beyond the image, and is NaN where a pixel is") {
  const LowerParams params;
  for (const KernelSet& set : usable_kernels()) {
    CAPTURE(name_of(set));
    const auto pooled = [&](float first) {
      return result_of(name_of(set), params, [&](GraphRunner& r, const LowerParams&) {
        const Tensor image = constant(r.graph, {first, -2, -3, -4, -5, -6, -7, -8, -9}, {1, 3, 3});
        return r.graph.add(op::MaxPool{{3, 2, 1}}, {image});
      });
    };
    CHECK(pooled(-1) == std::vector<float>{-1, -2, -4, -5});
    const std::vector<float> with_nan = pooled(NAN);
    CHECK(std::isnan(with_nan[0]));
    CHECK(std::vector(with_nan.begin() + 1, with_nan.end()) == std::vector<float>{-2, -4, -5});
  }
}

TEST_CASE("products of x of any strides, with everything that may follow them") {
  for (const auto operand : kOperands)
    for (const auto residual : kOperands) {
      const Shape shape = {35, 5, 3, 1};
      check_like_ggml(
          [&](GraphRunner& r, const LowerParams& p) { return p.linear(r.graph, operand(r, shape, 1), 67); });
      check_like_ggml([&](GraphRunner& r, const LowerParams& p) {
        Graph& g = r.graph;
        const Tensor h = activate(g, p.linear(g, operand(r, shape, 1), 35), Activation::gelu_erf);
        const Tensor y = multiply(g, h, p.parameter(g, 35));
        return add(g, residual(r, shape, 1), y);
      });
      check_like_ggml([&](GraphRunner& r, const LowerParams& p) {  // the residual on the other side
        Graph& g = r.graph;
        return add(g, p.linear(g, operand(r, shape, 1), 35, false), residual(r, shape, 1));
      });
    }
  check_like_ggml([&](GraphRunner& r, const LowerParams& p) {  // a residual for every token alike is no operand
    Graph& g = r.graph;
    return add(g, p.linear(g, input(r, {35, 5, 1, 1}), 35), input(r, {35, 1, 1, 1}));
  });
  check_like_ggml([&](GraphRunner& r, const LowerParams& p) {  // nor is a factor of every token
    Graph& g = r.graph;
    return multiply(g, p.linear(g, input(r, {35, 5, 1, 1}), 35), input(r, {1, 5, 1, 1}));
  });
}

TEST_CASE("convolutions, with everything that may follow them") {
  const Shape images = {8, 9, 7, 2};
  for (const auto operand : kOperands)
    for (const op::Window& window : {op::Window{1, 2, 0}, op::Window{2, 1, 1}})
      for (const int n_after : {0, 1, 2, 3}) {
        CAPTURE(window.size);
        CAPTURE(n_after);
        check_like_ggml([&](GraphRunner& r, const LowerParams& p) {
          Graph& g = r.graph;
          const Tensor x = g.add(op::Unfold{window}, {operand(r, images, 1)});  // [8 or 32, ...]
          Tensor y = p.linear(g, x, 24);
          if (n_after > 0) y = add(g, y, operand(r, y.shape(), 1));
          if (n_after > 1) y = activate(g, y, n_after == 2 ? Activation::relu : Activation::silu);
          return y;
        });
      }
  check_like_ggml([](GraphRunner& r, const LowerParams& p) {  // two of one window, then others that read it too
    Graph& g = r.graph;
    const Tensor x = g.add(op::Unfold{{2, 2, 0}}, {input(r, {8, 6, 4, 1})});
    const Tensor a = p.linear(g, x, 24, true, 0), b = p.linear(g, x, 24, false, 1);
    return add(g, activate(g, a, Activation::relu), b);
  });
  check_like_ggml([](GraphRunner& r, const LowerParams& p) {
    Graph& g = r.graph;
    const Tensor x = g.add(op::Unfold{{2, 2, 0}}, {input(r, {8, 6, 4, 1})});
    return concat(g, {p.linear(g, x, 24), x}, 0);
  });
}

TEST_CASE("gated products, whichever of gate and up is recorded first") {
  for (const bool gate_first : {true, false})
    for (const bool gate_left : {true, false})
      for (const auto operand : kOperands)
        check_like_ggml([&](GraphRunner& r, const LowerParams& p) {
          Graph& g = r.graph;
          const Tensor x = norm(g, op::NormKind::rms, {operand(r, {35, 5, 1, 1}, 1), p.parameter(g, 35)});
          Tensor gate, up;
          if (gate_first) gate = activate(g, p.linear(g, x, 67, true, 0), Activation::silu);
          up = p.linear(g, x, 67, false, 1);
          if (!gate_first) gate = activate(g, p.linear(g, x, 67, true, 0), Activation::silu);
          return p.linear(g, gate_left ? multiply(g, gate, up) : multiply(g, up, gate), 35);
        });
}

TEST_CASE("attention with rotated and normalized heads, segments, masks and batches") {
  struct Sizes {
    int d_head, n_head, n_head_kv, n_query, n_batch;
    std::vector<int> n_key;
    bool masked, normalized, rotated;
  };
  const Sizes all[] = {{8, 3, 3, 5, 1, {5}, false, false, false},    {8, 6, 2, 5, 2, {7}, true, true, true},
                       {8, 4, 1, 3, 1, {9, 3}, true, false, true},   {8, 2, 2, 1, 1, {1, 1, 4}, false, true, false},
                       {24, 2, 1, 13, 2, {33, 2}, true, true, true}, {24, 3, 1, 40, 1, {300}, true, false, true}};
  for (const Sizes& s : all)
    for (const auto operand : kOperands)
      check_like_ggml(
          [&](GraphRunner& r, const LowerParams& p) {
            Graph& g = r.graph;
            const auto heads = [&](int n_head, int n_token, bool prepared) {
              Tensor x = operand(r, {s.d_head, n_head, n_token, s.n_batch}, 2);
              if (prepared && s.normalized) x = norm(g, op::NormKind::rms, {x, p.parameter(g, s.d_head)});
              if (prepared && s.rotated) x = g.add(op::Rope{}, {x, input(r, {s.d_head, n_token, 1, 1})});
              return x;
            };
            const Tensor q = heads(s.n_head, s.n_query, true);
            std::vector<KeyValue> segments;
            int n_key = 0;
            for (const int n : s.n_key) {
              const Tensor k = heads(s.n_head_kv, n, true), v = heads(s.n_head_kv, n, false);
              segments.push_back({k, v});
              n_key += n;
            }
            Tensor mask;
            if (s.masked) {
              std::vector<float> values;
              for (int i = 0; i < s.n_query; ++i)
                for (int j = 0; j < n_key; ++j) values.push_back((3 * i + j) % 4 == 1 ? -INFINITY : 0.25f * (j % 3));
              mask = constant(g, values, {n_key, s.n_query});
            }
            return attention(g, q, segments, mask);
          },
          2e-5);
}

TEST_CASE("heads that several attentions read, and rotations that others read too") {
  check_like_ggml([](GraphRunner& r, const LowerParams& p) {
    Graph& g = r.graph;
    const Tensor table = input(r, {8, 5, 1, 1});
    const Tensor q = g.add(op::Rope{}, {input(r, {8, 3, 5, 1}, 2), table});
    const Tensor normed = norm(g, op::NormKind::rms, {input(r, {8, 3, 5, 1}, 2), p.parameter(g, 8)});
    const Tensor k = g.add(op::Rope{}, {normed, table}), v = input(r, {8, 3, 5, 1});
    const Tensor first = attention(g, q, {{k, v}}, {}), second = attention(g, k, {{q, v}, {k, v}}, {});
    return add(g, add(g, first, second), reshape(g, normed, {24, 5, 1, 1}));
  });
}

TEST_CASE("attention with more segments or wider heads than its kernels have room for is refused") {
  for (const KernelSet& set : lowered_kernels()) {
    const auto error_of = [&](int d_head, int n_segment) {
      GraphRunner r(ParamList(Keys(), nullptr), name_of(set));
      const Tensor q = input(r, {d_head, 1, 2, 1});
      const std::vector<KeyValue> segments(static_cast<std::size_t>(n_segment), {q, q});
      r.graph.name("result", attention(r.graph, q, segments, {}));
      const Status lowered = r.try_lower();
      return lowered.ok() ? "" : lowered.error().message();
    };
    CHECK(error_of(256, 6) == "");
    CHECK(error_of(257, 1).find("heads of at most 256") != std::string::npos);
    CHECK(error_of(8, 7).find("segments") != std::string::npos);
  }
}

TEST_CASE("one graph has every operation there is, and gives the same on all kernels") {
  std::vector<bool> recorded(std::variant_size_v<Op>);
  check_like_ggml([&](GraphRunner& r, const LowerParams& p) {
    Graph& g = r.graph;
    const Tensor ids = g.add(op::Constant{std::vector<std::int32_t>{2, 0, 1}}, {}, {3, 1, 1, 1});
    const Tensor rows = g.add(op::Gather{}, {g.add(op::Embedding{p.table()}, {ids}), ids});
    const Tensor patches = g.add(op::Patches{2}, {input(r, {4, 4, 3, 1})});
    const Tensor pooled = g.add(op::MaxPool{{3, 2, 1}}, {reshape(g, patches, {3, 4, 4, 1})});
    const Tensor windows = g.add(op::Unfold{{3, 1, 1}}, {pooled});
    const Tensor weighed =
        g.add(op::Depthwise{{3, 1, 1}}, {pooled, input(r, {27, 1, 1, 1}), constant(g, {1, 2, 3}, {3})});
    const Tensor cells = reshape(g, weighed, {3, 4, 1, 1});
    const Tensor attended = g.add(op::ChannelAttention{1}, {cells, cells, cells});
    const Tensor squares = g.add(op::PixelShuffle{2, 2}, {patches});
    const Tensor x = add(g, norm(g, op::NormKind::rms, {rows, p.parameter(g, 35)}), p.linear(g, rows, 35));
    const Tensor heads =
        g.add(op::Rope{}, {reshape(g, slice_features(g, x, 0, 34), {34, 1, 3, 1}), input(r, {34, 3, 1, 1})});
    const Tensor mixed = g.add(op::Attention{false}, {heads, heads, heads});
    const Tensor gated = multiply(g, activate(g, mixed, Activation::silu), scale(g, mixed, 0.5f));
    const Tensor one = g.add(op::Repeat{}, {reshape(g, slice_features(g, gated, 0, 1), {1, 3, 1, 1})}, {2, 3, 1, 1});
    const Tensor turned = g.add(op::Permute{{1, 0, 2, 3}}, {one});
    const Tensor all = concat(g, {gated, reshape(g, turned, {2, 3, 1, 1})}, 0);
    const Slot* kept = r.slot(std::vector<float>(36 * 3), {36, 3, 1, 1});
    g.add(op::Write{const_cast<Slot*>(kept)}, {all});
    const Tensor result =
        concat(g,
               {reshape(g, all, {108, 1, 1, 1}), reshape(g, squares, {48, 1, 1, 1}),
                reshape(g, windows, {108, 1, 1, 1}), reshape(g, attended, {12, 1, 1, 1}), constant(g, {1, 2}, {2})},
               0);
    for (const Node& node : g.nodes()) recorded[node.op.index()] = true;
    return result;
  });
  for (std::size_t i = 0; i < recorded.size(); ++i) {
    CAPTURE(i);  // of Op, in graph/op.h
    CHECK(recorded[i]);
  }
}

}  // namespace ops_test
