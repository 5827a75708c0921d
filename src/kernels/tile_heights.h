// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <utility>

/// Tiles are compiled for each height separately, so that their sums stay in registers.
namespace vla::kernels {

template <class F>
struct TileOfHeight {
  template <int kHeight>
  static void call(const F& tile) {
    tile.template operator()<kHeight>();
  }

  template <int... i>
  static void call(int height, const F& tile, std::integer_sequence<int, i...>) {
    static constexpr void (*kCalls[])(const F&) = {call<i + 1>...};
    kCalls[height - 1](tile);
  }
};

/// Calls tile.operator()<height>() for a height from 1 to kMost. `F` has a distinct type in each file, so that the
/// linker cannot merge functions compiled for different instructions.
template <int kMost, class F>
inline void with_height(int height, const F& tile) {
  TileOfHeight<F>::call(height, tile, std::make_integer_sequence<int, kMost>());
}

}  // namespace vla::kernels
