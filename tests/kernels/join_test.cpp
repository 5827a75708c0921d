// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/elementwise.h"
#include "support/graph_runner.h"

using namespace vla;
using test::ramp;
using test::run_graph;

namespace {

/// Keys of 2 heads, `n` tokens from number `first` of a longer sequence on; as a tensor of their own or as a view.
Tensor keys(Graph& g, const std::vector<float>& sequence, int first, int n, bool as_view) {
  constexpr int kHead = 3, kToken = 2 * kHead;
  if (!as_view) {
    const auto begin = sequence.begin() + first * kToken;
    return g.store().add_constant(std::vector<float>(begin, begin + n * kToken), {kHead, 2, n});
  }
  // Tokens of twice the width, of which the second half is left out.
  std::vector<float> wide(static_cast<std::size_t>(2 * kToken * n), -1.0f);
  for (int i = 0; i < kToken * n; ++i)
    wide[static_cast<std::size_t>(i / kToken * 2 * kToken + i % kToken)] =
        sequence[static_cast<std::size_t>(first * kToken + i)];
  const Tensor all = g.store().add_constant(wide, {kHead, 4, n});
  return ggml_view_3d(g.context(), all.node(), kHead, 2, n, all.node()->nb[1], all.node()->nb[2], 0);
}

}  // namespace

TEST_CASE("what was cut is whole again after joining, tensors of their own and views") {
  const std::vector<float> sequence = ramp(6 * 40, 3);
  for (int n_first : {1, 7, 39})
    for (bool first_is_view : {false, true})
      for (bool second_is_view : {false, true}) {
        const auto joined = run_graph([&](Graph& g) {
          return kernels::join(g, keys(g, sequence, 0, n_first, first_is_view),
                               keys(g, sequence, n_first, 40 - n_first, second_is_view), 2);
        });
        CHECK(joined == sequence);
      }
}
