// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "backend/store.h"
#include "bundle/params.h"

namespace vla {

/// The parameters of a policy, resident on a device. Matrices are widened to f32 at load, so that products round like
/// the float32 reference whatever the bundle's dtype; tables keep their dtype, since a looked-up row is widened
/// exactly.
class Weights {
 public:
  enum class Fill { no, yes };

  /// Every parameter must have its source: call ParamList::report first. Without filling, memory is reserved and never
  /// touched, which is enough to learn sizes. Errors: out_of_memory.
  static Result<Weights> load(const ParamList& list, const Device& device, Fill fill);

  Tensor operator[](const Param* param) const { return tensors_[static_cast<std::size_t>(param->id)]; }
  std::size_t size() const { return store_.size(); }
  Isa isa() const { return isa_; }
  std::size_t count() const { return tensors_.size(); }

 private:
  Weights(std::size_t n_param, Isa isa) : store_(n_param), isa_(isa) {}

  Store store_;
  Isa isa_;
  std::vector<Tensor> tensors_;
};

}  // namespace vla
