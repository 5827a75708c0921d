// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// How long a program takes, from one operation of each kind.
#include "lower/cpu/emit.h"
#include "lower_case.h"
#include "nn/linear.h"

namespace predict_test {

using namespace vla;
using namespace vla::test;

namespace {

constexpr int kWidth = 64, kWide = 8 * kWidth, kRows = 48;

/// Three equal blocks, each a stage of its own, and one of another width.
class Blocks {
 public:
  Blocks()
      : set_({piece("blk.0.up", kWidth), piece("blk.1.up", kWidth), piece("blk.2.up", kWidth), piece("up", kWide)}) {
    for (const char* path : {"blk.0.up", "blk.1.up", "blk.2.up"})
      linears_.emplace_back(set_.scope(path), kWidth, kWidth, Bias::no);
    linears_.emplace_back(set_.scope("up"), kWidth, kWide, Bias::no);
  }

  Tensor operator()(Graph& g, Tensor x) const {
    for (std::size_t i = 0; i < linears_.size(); ++i) {
      if (i > 0) g.end_stage("block");
      x = linears_[i](g, x);
    }
    return x;
  }
  const ParamList& list() const { return set_.list(); }

 private:
  static ParamSet::Piece piece(const std::string& path, int d_out) {
    return {path + ".weight", {kWidth, d_out}, ramp(static_cast<std::size_t>(kWidth * d_out), 0.1f)};
  }
  ParamSet set_;
  std::vector<Linear> linears_;
};

}  // namespace

TEST_CASE("operations of other blocks are alike, those of other sizes and kernels are not") {
  const char* text = "   5 avx512         1.47     0.122  linear lm.blk.0.attn_k  f32[144, 16] -> f32[16, 2]";
  const std::string likeness = lower::likeness_of(text);
  CHECK(likeness ==
        lower::likeness_of("  12 avx512         1.47     0.122  linear lm.blk.11.attn_k  f32[144, 16] -> f32[16, 2]"));
  CHECK(likeness !=
        lower::likeness_of("   5 avx512         1.47     0.122  linear lm.blk.0.attn_v  f32[144, 16] -> f32[16, 2]"));
  CHECK(likeness !=
        lower::likeness_of("   5 avx512         1.47     0.122  linear lm.blk.0.attn_k  f32[144, 17] -> f32[16, 2]"));
  CHECK(likeness !=
        lower::likeness_of("   5 avx2           1.47     0.122  linear lm.blk.0.attn_k  f32[144, 16] -> f32[16, 2]"));
  CHECK(lower::likeness_of("   5 attention %24 over 41\n   5 x") ==
        lower::likeness_of("   7 attention %3 over 41\n   7 x"));
}

TEST_CASE("a prediction has an entry for each stage, and equal blocks take equal times") {
  const Blocks blocks;
  GraphRunner r(blocks.list(), "");
  r.graph.name("result", blocks(r.graph, input(r, {kWidth, kRows, 1, 1})));
  const auto predicted = r.lower().predictions();
  REQUIRE(predicted.size() == 5);  // three stages, the rest, and what is prepared
  for (std::size_t i = 0; i < 4; ++i) {
    CHECK(predicted[i].n_launch >= 1);
    CHECK(predicted[i].seconds > 0);
    CHECK(predicted[i].seconds >= std::max(predicted[i].products, predicted[i].bytes));
  }
  CHECK(predicted[1].products == predicted[2].products);  // to the bit: one of them was timed
  CHECK(predicted[1].seconds < predicted[3].seconds);     // of an eighth of the weights
  CHECK(predicted[4].n_launch == 0);
}

TEST_CASE("weights that were never filled can be read: a program is predicted before anything is loaded") {
  const Blocks blocks;
  auto device = open_device(1, "");
  REQUIRE(device.ok());
  REQUIRE((*device)->load(blocks.list(), false).ok());
  Slots slots;
  Graph graph(slots);
  graph.write(blocks(graph, graph.input(slots.add_f32({kWidth, kRows, 1, 1}))), slots.add_f32({kWide, kRows, 1, 1}));
  REQUIRE((*device)->allocate(slots).ok());
  const auto program = (*device)->lower(graph);
  REQUIRE(program.ok());
  CHECK((*program)->predictions().at(3).seconds > 0);
}

}  // namespace predict_test
