// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <tuple>

#include "lower/ops.h"

namespace vla::lower {

/// How operands come to lie as operations need them. A target derives from it what it does to products, attention and
/// packing beside that.
class Layouts {
 public:
  virtual ~Layouts() = default;

 protected:
  explicit Layouts(Lowering& lowering) : lowering_(lowering) {}

  /// Copies the operands that do not lie as the step needs them, and notes them all as what it reads.
  void meet(Step& step, const Operands& operands);
  /// A value that the target makes on the way; `row`: elements from one row to the next.
  ValueId add_value(Shape shape, DType type, std::int64_t row);
  /// Has a product read x, or its norm, in another type, made just before the first that does.
  void round(const Step& step, LinearOp& op, DType type, std::int64_t row, const char* verb);

  /// Adds an operation that comes before the one at hand.
  virtual void add(Step step, CopyOp copy) = 0;
  virtual void add(Step step, RoundOp round) = 0;

 private:
  ValueId copied(ValueId id, int order);

  Lowering& lowering_;
  std::map<std::tuple<ValueId, const Node*, DType>, ValueId> rounded_;  // of x, or of its norm
};

}  // namespace vla::lower
