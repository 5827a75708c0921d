// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// A policy at `vla serve` behind a controller of 500 Hz, in C++20 over <vla/control.h>:
//
//   controller tcp://127.0.0.1:5555 limits.json "open the drawer" 10 camera1=top.png
//
// ADDRESS, the limits of the robot (docs/control.md), the sentence, seconds, and a picture for each view, where a robot
// has its cameras; a view without a file (camera2=) is one that the robot does not have.
//
// PolicyController has the shape of ros2_control's controllers, configure, activate, update, without ROS: command and
// state interfaces are numbers. `update` takes no lock, allocates nothing and never waits. The robot here is a
// simulation in main.
#include <vla/control.h>

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iterator>
#include <string>
#include <thread>
#include <vector>

namespace {

using namespace vla::control;

struct Camera {
  std::string view;
  std::string file;  // its bytes; a robot has the pixels of the newest frame here
};

class PolicyController {
 public:
  static constexpr double kRate = 500;

  /// Everything that allocates, waits or may fail.
  void configure(const std::string& address, const std::string& limits, const std::string& text,
                 std::vector<Camera> cameras) {
    client_ = std::make_unique<Client>(address);
    cameras_ = std::move(cameras);
    LoopOptions options = {.mode = Mode::async, .blend = Blend::linear(2), .on_note = OnNote::ignore};
    options.limits = Limits::read(limits).of(client_->spec());
    std::vector<Kind> kinds;
    bool is_place = true;
    for (const Column& column : options.limits->columns)
      kinds.push_back(column.kind), is_place &= column.kind == Kind::position || column.kind == Kind::gripper;
    // Repeating the last command is right for positions alone; velocities and differences would keep the robot moving.
    options.late = is_place ? Late::hold : Late::zero;
    if (client_->spec().n_action_steps == 0) options.replan_every = (client_->spec().horizon + 1) / 2;
    options.clock = [this] { return time_; };
    loop_ = std::make_unique<ChunkLoop>(*client_, options);
    between_ = std::make_unique<Interpolator>(kinds, Method::minimum_jerk, loop_->rate_hz());
    commands.assign(kinds.size(), 0);
    observe_ = [this, text](Observation& observation) {
      observation.frames.resize(cameras_.size());
      for (std::size_t i = 0; i < cameras_.size(); ++i)
        observation.frames[i] = {cameras_[i].view, 0, 0, std::as_bytes(std::span(cameras_[i].file))};
      observation.states.resize(client_->spec().states.size());
      for (std::size_t i = 0; i < observation.states.size(); ++i) {
        const Spec::State& state = client_->spec().states[i];
        observation.states[i].name = state.name;
        observation.states[i].values.assign(static_cast<std::size_t>(state.size), 0);
        for (std::size_t k = 0; k < observation.states[i].values.size() && k < states.size(); ++k)
          observation.states[i].values[k] = static_cast<float>(states[k]);
      }
      observation.text = text;
    };
  }

  /// The robot rests at these positions.
  void activate(const std::vector<double>& rest) {
    loop_->reset();
    loop_->start_at(rest);
    between_->start_at(rest);
    loop_->begin(observe_);
    next_step_ = time_;
  }

  /// A tick of the controller at this time, in seconds. False: something that needs a person; stop the robot.
  bool update(double time) {
    time_ = time;
    if (time_ >= next_step_) {
      action_ = loop_->step(observe_);
      if (action_.state == ActionState::stopped || action_.state == ActionState::failed) return false;
      if (!action_.values.empty()) between_->to(action_.values);
      begun_ = next_step_, next_step_ += 1 / loop_->rate_hz();
    }
    const double share = std::min(1.0, (time_ + 1 / kRate - begun_) * loop_->rate_hz());
    between_->at(share, commands);  // keeps the last command where the share has not grown
    return true;
  }

  const Action& action() const { return action_; }
  const ChunkLoop& loop() const { return *loop_; }
  const Spec& spec() const { return client_->spec(); }

  std::vector<double> states;   // what the robot's encoders say
  std::vector<float> commands;  // what its motors get

 private:
  std::unique_ptr<Client> client_;
  std::unique_ptr<ChunkLoop> loop_;
  std::unique_ptr<Interpolator> between_;
  std::vector<Camera> cameras_;
  ChunkLoop::Observe observe_;
  Action action_;
  double time_ = 0, begun_ = 0, next_step_ = 0;
};

int drive(int argc, char** argv) {
  std::vector<Camera> cameras;
  for (int i = 5; i < argc; ++i) {
    const std::string argument = argv[i];
    const std::size_t equals = argument.find('=');
    if (equals == std::string::npos)
      throw Error("usage", argument, "VIEW=FILE, or VIEW= for a camera that is not there", argument);
    Camera camera = {argument.substr(0, equals), ""};
    if (equals + 1 < argument.size()) {
      std::ifstream file(argument.substr(equals + 1), std::ios::binary);
      camera.file.assign(std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>());
      if (camera.file.empty()) throw Error("io", argument.substr(equals + 1), "a picture", "nothing that can be read");
    }
    cameras.push_back(camera);
  }
  PolicyController controller;
  controller.configure(argv[1], argv[2], argv[3], cameras);
  std::vector<double> joints(static_cast<std::size_t>(controller.spec().d_action), 0);
  controller.states = joints;
  controller.activate(joints);
  using SteadyClock = std::chrono::steady_clock;
  const auto start = SteadyClock::now();
  const int n_tick = static_cast<int>(std::atof(argv[4]) * PolicyController::kRate);
  for (int tick = 0; tick < n_tick; ++tick) {
    if (!controller.update(tick / PolicyController::kRate)) {
      std::fprintf(stderr, "error: %s\n", controller.action().problem->message);
      return 1;
    }
    for (std::size_t i = 0; i < joints.size(); ++i)
      joints[i] += 0.2 * (static_cast<double>(controller.commands[i]) - joints[i]);  // a servo
    controller.states = joints;
    if (tick % 250 == 249) {
      const LoopStats stats = controller.loop().stats();
      std::printf("%5.1f s  %s  command %8.4f ...  chunks %lld, held %lld, cut %lld, lost %lld\n",
                  (tick + 1) / PolicyController::kRate,
                  controller.action().state == ActionState::command ? "policy" : "held  ",
                  static_cast<double>(controller.commands[0]), static_cast<long long>(stats.chunks),
                  static_cast<long long>(stats.held), static_cast<long long>(stats.limited),
                  static_cast<long long>(stats.failed));
      std::fflush(stdout);
    }
    std::this_thread::sleep_until(start + std::chrono::microseconds(2000LL * (tick + 1)));
  }
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 5) {
    std::fprintf(stderr, "error: expected controller ADDRESS LIMITS TEXT SECONDS VIEW=FILE ...\n");
    return 2;
  }
  try {
    return drive(argc, argv);
  } catch (const Error& error) {
    std::fprintf(stderr, "error: %s: %s\n", error.code.c_str(), error.what());
    return 1;
  }
}
