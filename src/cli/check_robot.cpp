// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cli/check_robot.h"

#include <fmt/format.h>

#include <algorithm>
#include <functional>
#include <limits>
#include <map>

#include "base/printable.h"
#include "cli/observability.h"
#include "cli/say.h"

namespace vla::cli {
namespace {

constexpr const char* kImages = "observation.images.";

std::vector<Motor> aloha_motors() {
  return {{"left_waist", "radians"},         {"left_shoulder", "radians"},      {"left_elbow", "radians"},
          {"left_forearm_roll", "radians"},  {"left_wrist_angle", "radians"},   {"left_wrist_rotate", "radians"},
          {"left_gripper", "0 to 1"},        {"right_waist", "radians"},        {"right_shoulder", "radians"},
          {"right_elbow", "radians"},        {"right_forearm_roll", "radians"}, {"right_wrist_angle", "radians"},
          {"right_wrist_rotate", "radians"}, {"right_gripper", "0 to 1"}};
}

/// A motor's name without the `.pos` that LeRobot's features append.
std::string bare(std::string name) {
  if (name.ends_with(".pos")) name.resize(name.size() - 4);
  return name;
}

std::string bare_unit(const std::string& unit) {
  for (const auto& [word, others] : std::map<std::string, std::vector<std::string>>{
           {"radians", {"rad", "radian", "radians"}}, {"degrees", {"deg", "degree", "degrees"}}})
    if (std::find(others.begin(), others.end(), unit) != others.end()) return word;
  return unit;
}

std::string column_told(int i, const v1::Dimension& column) {
  const std::string name = column.name().empty() ? "unnamed" : printable(column.name());
  return fmt::format("{} {}{}", i, name, column.unit().empty() ? "" : fmt::format(" [{}]", printable(column.unit())));
}

/// Compares the robot's motors with columns of the policy, and collects the differences.
class Columns {
 public:
  Columns(const char* what, const google::protobuf::RepeatedPtrField<v1::Dimension>& columns, bool is_in_order,
          std::function<bool(int)> is_degrees)
      : what_(what), columns_(columns), is_in_order_(is_in_order), is_degrees_(std::move(is_degrees)) {}

  /// Returns the column of motor i for the table; adds its differences to `problems`.
  std::string of(int i, const Motor& motor, std::vector<std::string>& problems) const {
    if (i >= columns_.size()) {
      problems.push_back(fmt::format("{}: no column for {}, the policy has {}", what_, motor.name, columns_.size()));
      return "none";
    }
    const v1::Dimension& column = columns_[i];
    if (!column.name().empty() && bare(column.name()) != motor.name && !is_in_order_)
      problems.push_back(fmt::format("{} {}: expected {}, as the policy has it, found {}", what_, i,
                                     printable(column.name()), motor.name));
    const std::string unit = bare_unit(column.unit());
    const bool has_degrees = std::string(motor.unit) == "degrees", is_turned = is_degrees_(i);
    if (is_turned && !has_degrees)
      problems.push_back(
          fmt::format("{} {}: --map converts degrees, {} of the robot has {}", what_, i, motor.name, motor.unit));
    const bool is_angle = unit == "radians" || unit == "degrees";
    if (is_angle && unit != motor.unit && !(is_turned && has_degrees && unit == "radians"))
      problems.push_back(
          fmt::format("{} {}: the policy has {}, {} of the robot {}", what_, i, unit, motor.name, motor.unit));
    return column_told(i, column);
  }
  void check_rest(std::size_t n_motor, std::vector<std::string>& problems) const {
    for (int i = static_cast<int>(n_motor); i < columns_.size(); ++i)
      problems.push_back(fmt::format("{}: no motor for column {}", what_, column_told(i, columns_[i])));
  }
  bool is_named() const {
    return std::none_of(columns_.begin(), columns_.end(), [](const v1::Dimension& c) { return c.name().empty(); });
  }
  bool has_units() const {
    return std::none_of(columns_.begin(), columns_.end(), [](const v1::Dimension& c) { return c.unit().empty(); });
  }

 private:
  const char* what_;
  const google::protobuf::RepeatedPtrField<v1::Dimension>& columns_;
  bool is_in_order_;
  std::function<bool(int)> is_degrees_;  // whether --map converts a column
};

void print_cameras(const RobotCheck& check, std::vector<std::string>& problems) {
  const auto feeds = [&](const std::string& camera, const serve::Names::Entry& entry) {
    return entry.key == kImages + camera;
  };
  for (const std::string& camera : check.cameras) {
    const auto& views = check.names.views;
    const auto& ignored = check.names.ignored;
    const auto is_it = [&](const serve::Names::Entry& entry) { return feeds(camera, entry); };
    const auto view = std::find_if(views.begin(), views.end(), is_it);
    if (view != views.end())
      say(stdout, "camera {}\n    feeds the view {}\n", camera, view->feature);
    else if (std::any_of(ignored.begin(), ignored.end(), is_it))
      say(stdout, "camera {}\n    is not looked at\n", camera);
    else
      problems.push_back(
          fmt::format("camera {0} feeds no view: --map {1}{0}=VIEW, or --map {1}{0}= for one that is not looked at",
                      camera, kImages));
  }
  for (const serve::Names::Entry& entry : check.names.views) {
    const bool is_fed = std::any_of(check.cameras.begin(), check.cameras.end(),
                                    [&](const std::string& camera) { return feeds(camera, entry); });
    if (!is_fed)
      problems.push_back(fmt::format("view {}: no camera feeds it, under the key {}", entry.feature, entry.key));
  }
  for (const std::string& view : check.names.absent)
    say(stdout, "no camera\n    feeds the view {}: absent, as --absent says\n", view);
}

}  // namespace

const std::vector<RobotModel>& robot_models() {
  static const std::vector<RobotModel> models = {
      {"so101",
       {{"shoulder_pan", "degrees"},
        {"shoulder_lift", "degrees"},
        {"elbow_flex", "degrees"},
        {"wrist_flex", "degrees"},
        {"wrist_roll", "degrees"},
        {"gripper", "0 to 100"}},
       {}},
      {"aloha", aloha_motors(), {"cam_high", "cam_low", "cam_left_wrist", "cam_right_wrist"}}};
  return models;
}

int RobotCheck::print() const {
  std::vector<std::string> problems;
  const v1::StateSpec& state = description.states(0);
  const serve::Convention& convention = names.states.front().convention;
  const auto is_turned = [this](int i) {
    return std::any_of(names.actions.begin(), names.actions.end(), [i](const serve::Names::Columns& c) {
      return c.convention.is_degrees && c.begin <= static_cast<std::size_t>(i) && static_cast<std::size_t>(i) < c.end;
    });
  };
  const auto of_state = [&](int) { return convention.is_degrees; };
  const Columns states("state", state.dimensions(), convention.is_in_order, of_state);
  const Columns actions("action", description.actions(), convention.is_in_order, is_turned);
  std::map<std::string, observe::Page::Range> ranges;
  add_ranges(policy, ranges);
  const auto range = ranges.find(policy.bundle().embodiment() + "/" + state.name());
  say(stdout, "{:<20} {:<9} {:<34} {:<24} {}\n", "motor", "unit", "state", "in training", "action");
  for (std::size_t i = 0; i < robot.motors.size(); ++i) {
    const Motor& motor = robot.motors[i];
    const int column = static_cast<int>(i);
    const std::string trained = range == ranges.end() || i >= range->second.low.size()
                                    ? "unknown"
                                    : fmt::format("{:.4g} to {:.4g}", range->second.low[i], range->second.high[i]);
    say(stdout, "{:<20} {:<9} {:<34} {:<24} {}\n", motor.name, motor.unit, states.of(column, motor, problems), trained,
        actions.of(column, motor, problems));
  }
  states.check_rest(robot.motors.size(), problems), actions.check_rest(robot.motors.size(), problems);
  print_cameras(*this, problems);
  if (!states.is_named() || !actions.is_named())
    say(stdout, "note: the bundle does not name all columns: compare their order with the data set's\n");
  if (!states.has_units() || !actions.has_units())
    say(stdout, "note: the bundle does not say all units: compare `in training` with what the robot shows\n");
  if (description.rate_hz() > 0)
    say(stdout, "rate\n    {:g} rows a second, {} rows a chunk\n", description.rate_hz(), description.horizon());
  else
    problems.emplace_back("the bundle does not say its control rate: the loop has to be told it");
  for (const std::string& problem : problems) say(stdout, "problem: {}\n", problem);
  return static_cast<int>(problems.size());
}

std::string plot_chunk(const std::vector<float>& rows, const std::vector<std::string>& names,
                       const std::vector<std::optional<float>>& state) {
  constexpr int kWidth = 300, kHeight = 120, kLeft = 10, kTop = 22, kColumns = 3;
  const std::size_t d = names.size(), n_row = rows.size() / d;
  const std::size_t n_line = (d + kColumns - 1) / kColumns;
  std::string svg = fmt::format(
      "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{}\" height=\"{}\" font-family=\"sans-serif\" "
      "font-size=\"11\">\n"
      "<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n",
      kColumns * (kWidth + 2 * kLeft), n_line * (kHeight + 2 * kTop));
  for (std::size_t column = 0; column < d; ++column) {
    double low = std::numeric_limits<double>::infinity(), high = -low;
    const auto see = [&](double value) { low = std::min(low, value), high = std::max(high, value); };
    for (std::size_t row = 0; row < n_row; ++row) see(rows[row * d + column]);
    if (state[column]) see(*state[column]);
    const double room = high > low ? high - low : 1;
    const double left = static_cast<double>(column % kColumns) * (kWidth + 2 * kLeft) + kLeft;
    const double top = static_cast<double>(column / kColumns) * (kHeight + 2 * kTop) + kTop;
    const auto x = [&](double row) { return left + kWidth * (row + 1) / static_cast<double>(n_row + 1); };
    const auto y = [&](double value) { return top + kHeight * (high - value) / room; };
    std::string points;
    for (std::size_t row = 0; row < n_row; ++row)
      points += fmt::format("{:.1f},{:.1f} ", x(static_cast<double>(row)), y(rows[row * d + column]));
    std::string name;
    for (const char c : printable(names[column])) name += c == '<' ? "&lt;" : c == '&' ? "&amp;" : std::string(1, c);
    svg += fmt::format("<text x=\"{:.0f}\" y=\"{:.0f}\">{}: {:.4g} to {:.4g}</text>\n", left, top - 6, name, low, high);
    svg += fmt::format("<rect x=\"{:.0f}\" y=\"{:.0f}\" width=\"{}\" height=\"{}\" fill=\"none\" stroke=\"#ccc\"/>\n",
                       left, top, kWidth, kHeight);
    svg += fmt::format("<polyline points=\"{}\" fill=\"none\" stroke=\"#1663c7\" stroke-width=\"1.5\"/>\n", points);
    if (state[column])
      svg += fmt::format(
          "<line x1=\"{:.1f}\" y1=\"{:.1f}\" x2=\"{:.1f}\" y2=\"{:.1f}\" stroke=\"#c22\" stroke-dasharray=\"3 3\"/>\n"
          "<circle cx=\"{:.1f}\" cy=\"{:.1f}\" r=\"3\" fill=\"#c22\"/>\n",
          x(-1), y(*state[column]), x(0), y(rows[column]), x(-1), y(*state[column]));
  }
  return svg + "</svg>\n";
}

}  // namespace vla::cli
