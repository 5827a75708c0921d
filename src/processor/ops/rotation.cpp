// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// Converts rotations between representations: a state's for the network, an action's for the robot. Each product and
// sum is rounded to float32 in the reference's order. torch's sines and angles differ between machines in the last
// digits; here they are the nearest float32 values. Source: Isaac-GR00T (N1.5) gr00t/data/transform/state_action.py
// (RotationTransform) over pytorch3d 0.7.6 transforms/rotation_conversions.py.
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "processor/json_fields.h"
#include "processor/ops/matrix.h"
#include "processor/recipe.h"

namespace vla {
namespace {

using Axes = std::array<std::size_t, 3>;

constexpr std::size_t kRows = 6;  // elements in the first two rows of a matrix

/// Order of rotations around roll (x), pitch (y) and yaw (z); the last one is applied first.
struct EulerOrder {
  const char* name;
  Axes axes;
};
constexpr EulerOrder kEulerOrders[] = {{"euler_angles_rpy", {0, 1, 2}}, {"euler_angles_ryp", {0, 2, 1}},
                                       {"euler_angles_pry", {1, 0, 2}}, {"euler_angles_pyr", {1, 2, 0}},
                                       {"euler_angles_yrp", {2, 0, 1}}, {"euler_angles_ypr", {2, 1, 0}}};

float sine(float x) { return static_cast<float>(std::sin(static_cast<double>(x))); }
float cosine(float x) { return static_cast<float>(std::cos(static_cast<double>(x))); }
float arc_tangent(float y, float x) {
  return static_cast<float>(std::atan2(static_cast<double>(y), static_cast<double>(x)));
}

/// q: real part first, of any length.
Matrix3<float> of_quaternion(const float* q) {
  const float r = q[0], i = q[1], j = q[2], k = q[3];
  const float s = 2.0f / (r * r + i * i + j * j + k * k);
  return {1 - s * (j * j + k * k), s * (i * j - k * r),     s * (i * k + j * r),
          s * (i * j + k * r),     1 - s * (i * i + k * k), s * (j * k - i * r),
          s * (i * k - j * r),     s * (j * k + i * r),     1 - s * (i * i + j * j)};
}

/// v: axis times angle.
Matrix3<float> of_axis_angle(const float* v) {
  const float angle = std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), half = angle * 0.5f;
  const float scale = angle < 1e-6f ? 0.5f - angle * angle / 48 : sine(half) / angle;
  const float quaternion[] = {cosine(half), v[0] * scale, v[1] * scale, v[2] * scale};
  return of_quaternion(quaternion);
}

Matrix3<float> around(std::size_t axis, float angle) {
  Matrix3<float> out{};
  const std::size_t j = (axis + 1) % 3, k = (axis + 2) % 3;
  out[4 * axis] = 1;
  out[4 * j] = out[4 * k] = cosine(angle);
  out[3 * k + j] = sine(angle);
  out[3 * j + k] = -out[3 * k + j];
  return out;
}

Matrix3<float> of_euler_angles(const Axes& axes, const float* angles) {
  const Matrix3<float> first = product(around(axes[0], angles[0]), around(axes[1], angles[1]));
  return product(first, around(axes[2], angles[2]));
}

/// The angle around the first or last axis, from the matrix elements that hold its sine and cosine times a common
/// factor. `line`: the row (last axis) or column (first axis) with these elements.
float outer_angle(std::size_t axis, std::size_t middle, const std::array<float, 3>& line, bool is_row) {
  std::size_t i = (axis + 2) % 3, k = (axis + 1) % 3;
  if (is_row) std::swap(i, k);
  const bool even = (axis + 1) % 3 == middle;
  return is_row == even ? arc_tangent(line[i], line[k]) : arc_tangent(-line[k], line[i]);
}

/// Writes three angles. The middle one is NaN if rounding makes its sine larger than 1, as in the reference.
void write_euler_angles(const Axes& axes, const Matrix3<float>& m, std::span<double> out) {
  const auto [first, middle, last] = axes;
  const bool even = (first + 1) % 3 == middle;
  const float sine_of_middle = even ? m[3 * first + last] : -m[3 * first + last];
  out[0] = outer_angle(first, middle, {m[last], m[3 + last], m[6 + last]}, false);
  out[1] = static_cast<float>(std::asin(static_cast<double>(sine_of_middle)));
  out[2] = outer_angle(last, middle, {m[3 * first], m[3 * first + 1], m[3 * first + 2]}, true);
}

// --- the ops "rotation" ---------------------------------------------------------------------------------------------

/// Replaces a rotation in the state by the first two rows of its matrix.
struct RotationStateOp final : StateOp {
  int from = 0;  // 0: quaternion, 1: axis times angle, 2 or more: kEulerOrders[from - 2]
  int column = 0;
  bool scales = false;  // maps [-1, 1] to itself, which loses digits as in the reference

  Stage stage() const override { return Stage::widened; }
  Status bind(StateLayout& layout, const std::string& where) override {
    const auto first = static_cast<std::size_t>(column), width = std::size_t{from == 0 ? 4U : 3U};
    std::size_t start = 0, index = 0;
    while (index < layout.dims.size() && start < first) start += static_cast<std::size_t>(layout.dims[index++]);
    if (index == layout.dims.size() || start != first || static_cast<std::size_t>(layout.dims[index]) != width)
      return misfit(where + ".column", fmt::format("the first column of a feature of {} numbers", width),
                    std::to_string(column));
    if (first + width > layout.n_unmoved)
      return misfit(where + ".column", fmt::format("a feature in front of column {}", layout.n_unmoved),
                    std::to_string(column));
    layout.n_unmoved = first;
    layout.width += kRows - width;
    feature_ = layout.features.names()[index];
    return {};
  }
  Status finish(std::vector<float>& state, std::vector<int>&) const override {
    const auto place = state.begin() + column;
    Matrix3<float> matrix = from == 0 ? of_quaternion(&*place) : from == 1 ? of_axis_angle(&*place) : of_euler(&*place);
    if (!std::all_of(matrix.begin(), matrix.end(), [](float x) { return std::isfinite(x); }))
      return Error{Code::bad_observation, feature_, "a rotation",
                   fmt::format("numbers of none, the first of which is {}", *place)};
    if (scales)
      for (float& x : matrix) x = 2 * ((x + 1) / 2) - 1;
    state.insert(place, kRows - (from == 0 ? 4 : 3), 0.0f);
    std::copy_n(matrix.begin(), kRows, state.begin() + column);
    return {};
  }

 private:
  Matrix3<float> of_euler(const float* angles) const { return of_euler_angles(kEulerOrders[from - 2].axes, angles); }
  std::string feature_;
};

std::vector<const char*> euler_names() {
  std::vector<const char*> names;
  for (const EulerOrder& order : kEulerOrders) names.push_back(order.name);
  return names;
}

Status parse_rotation_state(JsonFields& fields, Recipe& recipe) {
  const auto last = recipe.state.empty() ? StateOp::Stage::convention : recipe.state.back()->stage();
  if (last > StateOp::Stage::widened) return misplaced(fields, "rotation before pad");
  auto op = std::make_unique<RotationStateOp>();
  std::vector<const char*> from = euler_names();
  from.insert(from.begin(), {"quaternion", "axis_angle"});
  VLA_TRY(op->from, fields.choice("from", from));
  VLA_CHECK(fields.choice("to", {"rotation_6d"}));
  VLA_TRY(op->column, fields.integer("column", 0, kMaxVector - 1));
  VLA_TRY(const int normalization, fields.choice("normalize", {"identity", "groot_n1_5_min_max"}));
  op->scales = normalization == 1;
  recipe.state.push_back(std::move(op));
  return {};
}

/// Converts three values of an action from axis times angle to Euler angles.
struct RotationActionOp final : ActionOp {
  int column = 0;
  Axes axes{};

  Status bind(ActionLayout& layout, const std::string& where) override {
    if (column + 3 <= layout.width) return {};
    return misfit(where + ".column", fmt::format("3 columns of {} from here on", layout.width), std::to_string(column));
  }
  void apply(std::vector<double>& row, const RowPlace&) const override {
    const std::span<double> numbers = std::span(row).subspan(static_cast<std::size_t>(column), 3);
    const std::vector<float> vector(numbers.begin(), numbers.end());
    write_euler_angles(axes, of_axis_angle(vector.data()), numbers);
  }
};

Status parse_rotation_action(JsonFields& fields, Recipe& recipe) {
  auto op = std::make_unique<RotationActionOp>();
  VLA_CHECK(fields.choice("from", {"axis_angle"}));
  VLA_TRY(const int order, fields.choice("to", euler_names()));
  op->axes = kEulerOrders[order].axes;
  VLA_TRY(op->column, fields.integer("column", 0, kMaxVector - 1));
  recipe.action.push_back(std::move(op));
  return {};
}

}  // namespace

Ops rotation_ops() {
  return {{"state", "rotation", parse_rotation_state}, {"action", "rotation", parse_rotation_action}};
}

}  // namespace vla
