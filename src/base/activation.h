// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

namespace vla {

/// Elementwise nonlinearities. Sources: torch gelu(approximate="tanh"), gelu(approximate="none"), silu, relu,
/// relu(x)^2, and mish.
enum class Activation { none, gelu_tanh, gelu_erf, silu, relu, relu_squared, mish };

constexpr const char* activation_name(Activation activation) {
  constexpr const char* kNames[] = {"none", "gelu_tanh", "gelu_erf", "silu", "relu", "relu_squared", "mish"};
  return kNames[static_cast<int>(activation)];
}

}  // namespace vla
