// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <tuple>

#include "lower/ops.h"

namespace vla::lower {

/// Makes operands meet their operations' needs. A target derives its own class for products, attention and packing.
class Layouts {
 public:
  virtual ~Layouts() = default;

 protected:
  explicit Layouts(Lowering& lowering) : lowering_(lowering) {}

  /// Copies the operands that do not meet their needs, and records all as the step's reads.
  void meet(Step& step, const Operands& operands);
  /// Adds a value that the target makes. `row`: elements from one row to the next.
  ValueId add_value(Shape shape, DType type, std::int64_t row);
  /// Makes a product read x, or its norm, in another type. The first such product adds the conversion; later ones share
  /// it.
  void round(const Step& step, LinearOp& op, DType type, std::int64_t row, const char* verb);

  /// Adds an operation before the current one.
  virtual void add(Step step, CopyOp copy) = 0;
  virtual void add(Step step, RoundOp round) = 0;

 private:
  ValueId copied(ValueId id, int order);

  Lowering& lowering_;
  std::map<std::tuple<ValueId, const Node*, DType>, ValueId> rounded_;  // converted x, or its norm
};

}  // namespace vla::lower
