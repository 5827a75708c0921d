// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

struct ggml_tensor;

namespace vla {

/// A value in a graph: a handle to a ggml tensor that modules and policies pass on without knowing ggml.
/// Shapes follow ggml, fastest first: a sequence of tokens is [d_model, n_token].
class Tensor {
 public:
  Tensor() = default;
  Tensor(ggml_tensor* node) : node_(node) {}

  ggml_tensor* node() const { return node_; }
  explicit operator bool() const { return node_ != nullptr; }
  std::int64_t dim(int i) const;
  /// All dimensions up to the last that is not 1.
  std::vector<std::int64_t> shape() const;

 private:
  ggml_tensor* node_ = nullptr;
};

}  // namespace vla
