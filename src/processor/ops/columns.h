// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>
#include <string>
#include <vector>

#include "processor/ops/op.h"

namespace vla {

/// Checks that an op's columns exist. `where` is the op's place. Errors: bad_bundle.
Status check_columns(const std::vector<int>& columns, std::size_t width, const std::string& where);

/// The field "columns"; without it the op works on all columns.
using SomeColumns = std::optional<std::vector<int>>;
Result<SomeColumns> read_some_columns(JsonFields& fields);
/// The selected columns of `width`.
std::vector<int> chosen_columns(const SomeColumns& columns, std::size_t width);

/// `x * scale + shift` in the selected columns.
struct ColumnAffine {
  std::vector<int> columns;
  double scale = 1.0;
  double shift = 0.0;
};

/// Converts a gripper's opening, `x * scale + shift`, to the angle of the servo horn that drives it, from the lengths
/// of horn and arm. One op, because near the end of the range the angle depends on the opening's last digit.
struct HornAngle {
  std::vector<int> columns;
  double scale = 1.0;
  double shift = 0.0;
  double arm_length = 0.0;
  double horn_radius = 0.0;
};

/// In the selected columns: `then` for values strictly above `above`, `otherwise` for the rest.
struct Threshold {
  std::vector<int> columns;
  float above = 0.0f;
  float then = 0.0f;
  float otherwise = 0.0f;
};

/// In the selected columns: the sign, -1, 0 or 1.
struct Sign {
  std::vector<int> columns;
};

/// In the selected columns: 1 / (1 + exp(-x)).
struct Sigmoid {
  std::vector<int> columns;
};

struct Clip {
  float low = 0.0f;
  float high = 0.0f;
  SomeColumns columns = {};
};

/// Discretizes values: the number of `count` evenly spaced edges from `low` (`high` excluded) that are not above the
/// value, minus 1.
struct Bins {
  double low = 0.0;
  double high = 0.0;
  int count = 0;
};

/// Conventions of robots and prompts, for single columns of a state or action row. As in the reference they compute in
/// double, and each result is rounded to float32 once. Columns must be inside `values`.

/// `x * scale + shift`, in place, e.g. to flip a joint (scale -1) or to change a gripper's range.
void map_columns(const ColumnAffine& op, std::span<float> values);

/// Replaces a gripper's value by the servo horn's angle (radians), asin((r^2 + x^2 - a^2) / (2 r x)) with the argument
/// clamped to [-1, 1], where x = value * scale + shift is the opening (metres). Source: openpi policies/aloha_policy.py
/// (_gripper_to_angular).
void map_columns(const HornAngle& op, std::span<float> values);

/// Applies a threshold in place: `then` for values strictly above it, else `otherwise`. Values that are not finite
/// stay, so that later checks find them. Source: lerobot policies/evo1/processor_evo1.py (Evo1ActionProcessorStep).
void map_columns(const Threshold& op, std::span<float> values);

/// The sign of every value, in place; 0 for 0. NaN stays, so that later checks find it.
void map_columns(const Sign& op, std::span<float> values);

/// The sigmoid of every value, in place. Source: lerobot policies/xvla/action_hub.py (postprocess).
void map_columns(const Sigmoid& op, std::span<float> values);

/// Clamps the columns of `op` to [low, high], in place. Values that are not finite stay, so that later checks find
/// them.
void hold(const Clip& op, std::span<float> values);

/// Discretizes each value: the number of edges low + i * (high - low) / count, i in [0, count), that are not above it,
/// minus 1. That is -1 below `low` and count - 1 from the last edge on. Comparisons are exact. Values must not be NaN.
/// Source: numpy digitize and linspace, as in lerobot policies/pi05/processor_pi05.py.
std::vector<int> bins(const Bins& op, std::span<const float> values);

}  // namespace vla
