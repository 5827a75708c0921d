// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Two products that blocks of rows go through, on a machine with AMX or on one that is emulated (test_amx_machine):
// they are chosen where they pay, and change no number.
#include "lower_case.h"
#include "nn/linear.h"
#include "support/kernel_rows.h"

namespace blocks_test {

using namespace vla;
using namespace vla::test;

namespace {

constexpr int kWidth = 32, kInner = 1000, kRows = 1059, kLayers = 2;

/// An MLP of the common form: a norm, a product, something that is not linear, a product, what was before.
class Mlp {
 public:
  explicit Mlp(int inner)
      : set_({piece("gate", kWidth, inner),
              piece("up", kWidth, inner),
              piece("down", inner, kWidth),
              {"norm.weight", {kWidth}, ramp(kWidth, 1)}}),
        gate_(set_.scope("gate"), kWidth, inner, Bias::no),
        up_(set_.scope("up"), kWidth, inner, Bias::no),
        down_(set_.scope("down"), inner, kWidth, Bias::no),
        norm_(set_.scope("norm").vector("weight", kWidth)) {}

  Tensor operator()(Graph& g, Tensor x, bool gated) const {
    const Tensor normed = g.add(op::Norm{op::NormKind::rms, 1e-5f}, {x, g.parameter(norm_)});
    Tensor inner = activate(g, (gated ? gate_ : up_)(g, normed), Activation::gelu_tanh);
    if (gated) inner = multiply(g, inner, up_(g, normed));
    return add(g, down_(g, inner), x);
  }
  const ParamList& list() const { return set_.list(); }

 private:
  static ParamSet::Piece piece(const char* name, int d_in, int d_out) {
    return {
        std::string(name) + ".weight", {d_in, d_out}, ramp(static_cast<std::size_t>(d_in * d_out), 0.1f), DType::bf16};
  }
  ParamSet set_;
  Linear gate_, up_, down_;
  const Param* norm_;
};

struct Lowered {
  std::string text;
  std::vector<float> result;
};

Lowered run(const Mlp& mlp, bool gated, int n_row, int n_thread) {
  GraphRunner r(mlp.list(), "amx", GraphRunner::is_result, n_thread);
  Tensor x = input(r, {kWidth, n_row, 1, 1});
  for (int layer = 0; layer < kLayers; ++layer) x = mlp(r.graph, x, gated && layer == 0);
  r.graph.name("result", x);
  Lowered lowered = {r.lower().text(), {}};
  r.run();
  lowered.result = r.tap("result");
  return lowered;
}

/// The results of how many products stay with the thread that made them.
int n_kept(const std::string& text, const std::string& blocks) {
  const std::string kept = "-> bf16 tiles [1000, 1059]@thread, " + blocks + " blocks of rows\n";
  int n = 0;
  for (std::size_t at = 0; (at = text.find(kept, at)) != std::string::npos; ++at) ++n;
  return n;
}

}  // namespace

TEST_CASE("amx: a block of rows goes through both products of an MLP" * doctest::skip(lacks(kernel_set::amx))) {
  const Mlp mlp(kInner);
  for (const bool gated : {false, true}) {
    const Lowered whole = run(mlp, gated, kRows, 9);  // too few rows for so many threads
    CHECK(whole.text.find("blocks") == std::string::npos);
    const std::pair<int, const char*> threads[] = {{1, "3"}, {2, "4"}, {5, "5"}};
    for (const auto& [n_thread, n_block] : threads) {
      CAPTURE(n_thread);
      const Lowered blocked = run(mlp, gated, kRows, n_thread);
      CHECK(n_kept(blocked.text, n_block) == kLayers);
      CHECK(blocked.result == whole.result);
    }
  }
}

TEST_CASE("amx: rows stay whole where blocks do not pay" * doctest::skip(lacks(kernel_set::amx))) {
  const auto blocks = [](int inner, int n_row, int n_thread) {
    return run(Mlp(inner), false, n_row, n_thread).text.find("blocks") != std::string::npos;
  };
  CHECK(blocks(kInner, kRows, 8));
  CHECK_FALSE(blocks(kInner, 1024, 2));  // the L2 cache keeps them all
  CHECK_FALSE(blocks(4128, 300, 1));     // too few rows of such a width
}

}  // namespace blocks_test
