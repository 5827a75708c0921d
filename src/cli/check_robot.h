// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "engine/engine.h"
#include "serve/names.h"

namespace vla::cli {

/// A motor: the name and the unit of its reading and command.
struct Motor {
  const char *name, *unit;
};

/// A robot of LeRobot: its motors in LeRobot's order, and its cameras if they have usual names.
struct RobotModel {
  const char* name;
  std::vector<Motor> motors;
  std::vector<std::string> cameras;
};

/// The known robot models.
const std::vector<RobotModel>& robot_models();

/// Compares a robot with a policy that `vla serve --lerobot` would serve to it.
struct RobotCheck {
  const RobotModel& robot;
  std::vector<std::string> cameras;  // from the robot's configuration
  const serve::Names& names;
  const v1::Description& description;
  const Robot& policy;

  /// Prints the column of each motor, the view of each camera, and what is missing. Returns the number of problems.
  int print() const;
};

/// Draws each column of a chunk over its rows as SVG, with the robot's state before the chunk for the columns that have
/// one.
std::string plot_chunk(const std::vector<float>& rows, const std::vector<std::string>& names,
                       const std::vector<std::optional<float>>& state);

}  // namespace vla::cli
