// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>
#include <string>
#include <vector>

#include "processor/ops/op.h"

namespace vla {

/// The columns that an op names must exist. `where` is the op's place. Errors: bad_bundle.
Status check_columns(const std::vector<int>& columns, std::size_t width, const std::string& where);

/// The field "columns" where an op has it; without it the op works on all columns.
using SomeColumns = std::optional<std::vector<int>>;
Result<SomeColumns> read_some_columns(JsonFields& fields);
/// The columns that are meant of `width`.
std::vector<int> chosen_columns(const SomeColumns& columns, std::size_t width);

/// `x * scale + shift` in the columns named.
struct ColumnAffine {
  std::vector<int> columns;
  double scale = 1.0;
  double shift = 0.0;
};

/// The opening of a gripper, `x * scale + shift`, as the angle of the servo horn that drives it, by the lengths of horn
/// and arm. It is one op because the angle of a horn near its end depends on the last digit of the opening.
struct HornAngle {
  std::vector<int> columns;
  double scale = 1.0;
  double shift = 0.0;
  double arm_length = 0.0;
  double horn_radius = 0.0;
};

/// In the columns named, `then` for what is strictly above `above`, `otherwise` for the rest.
struct Threshold {
  std::vector<int> columns;
  float above = 0.0f;
  float then = 0.0f;
  float otherwise = 0.0f;
};

/// In the columns named, -1, 0 or 1.
struct Sign {
  std::vector<int> columns;
};

/// In the columns named, 1 / (1 + exp(-x)).
struct Sigmoid {
  std::vector<int> columns;
};

struct Clip {
  float low = 0.0f;
  float high = 0.0f;
  SomeColumns columns = {};
};

/// Values to integers: how many of `count` evenly spaced edges from `low` on (`high` left out) are not above,
/// less 1.
struct Bins {
  double low = 0.0;
  double high = 0.0;
  int count = 0;
};

/// Conventions of robots and of prompts, on single columns of a state or of an action row. The reference computes them
/// in double precision, and each result is rounded to float32 once. Columns must lie inside `values`.

/// `x * scale + shift`, in place: a flipped joint is scale -1, a gripper's range is any two values.
void map_columns(const ColumnAffine& op, std::span<float> values);

/// The angle of a gripper's servo horn (radians) from the opening x (metres) that a value stands for, in place:
/// asin((r^2 + x^2 - a^2) / (2 r x)) with the argument held in [-1, 1].
/// Source: openpi policies/aloha_policy.py (_gripper_to_angular).
void map_columns(const HornAngle& op, std::span<float> values);

/// The two values of a threshold, in place: `then` for what is strictly above it, else `otherwise`. What is not a
/// finite number stays, so that it is still found.
/// Source: lerobot policies/evo1/processor_evo1.py (Evo1ActionProcessorStep).
void map_columns(const Threshold& op, std::span<float> values);

/// The sign of every value, in place: 0 of 0. What is not a number stays, so that it is still found.
void map_columns(const Sign& op, std::span<float> values);

/// The sigmoid of every value, in place. Source: lerobot policies/xvla/action_hub.py (postprocess).
void map_columns(const Sigmoid& op, std::span<float> values);

/// Every value of its columns held between the two of a clip, in place. What is not a finite number stays, so that it
/// is still found.
void hold(const Clip& op, std::span<float> values);

/// The integer of each value: how many edges low + i * (high - low) / count, i in [0, count), are not above it,
/// less 1. So it is -1 below `low` and count - 1 from the last edge on. Comparisons are exact. NaN must not come here.
/// Source: numpy digitize and linspace, as in lerobot policies/pi05/processor_pi05.py.
std::vector<int> bins(const Bins& op, std::span<const float> values);

}  // namespace vla
