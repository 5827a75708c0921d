// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <span>

namespace vla {

/// Formats of a pose: position, then rotation.
enum class PoseFormat {
  rotation_6d,      // first two rows of the matrix: nine values in all
  rotation_vector,  // axis times angle: six values in all
};
std::size_t pose_size(PoseFormat format);

/// A rigid motion: x -> rotation x + position.
struct Pose {
  std::array<double, 3> position;
  std::array<double, 9> rotation;  // row by row
};

/// Orthogonalizes the rows of a 6D rotation in their own precision, then takes the nearest rotation in double. Rows
/// without a direction give values that are not finite.
Pose read_pose(PoseFormat format, std::span<const float> numbers);
Pose read_pose(PoseFormat format, std::span<const double> numbers);
void write_pose(PoseFormat format, const Pose& pose, std::span<double> numbers);

/// Transforms `relative` from the frame of `reference` to the world.
Pose compose(const Pose& reference, const Pose& relative);

}  // namespace vla
