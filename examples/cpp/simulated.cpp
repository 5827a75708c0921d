// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The loop of a robot in a simulator's time, for a simulator in any language that speaks through a pipe
// (examples/aloha/latency.py):
//
//   simulated ADDRESS VIEW STATE TEXT sync|async LATENCY       of a server, of one camera; seconds
//
// A line `step SECONDS state...` is one control period. Where the loop wants a frame, it answers `look`, and gets a
// line `WIDTH HEIGHT` and the RGB bytes. Then comes `SECONDS command|held|none actions...`; later SECONDS than the
// period's mean that the robot waited for its chunk, as `sync` does. `reset` begins an episode.
#include <algorithm>
#include <cstdio>
#include <iostream>
#include <optional>
#include <span>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "vla/control.h"

using namespace vla::control;

namespace {

/// A policy whose answer arrives `latency` simulated seconds after its observation, however long it really takes.
class LatePolicy : public Policy {
 public:
  LatePolicy(Client& client, double latency) : client_(client), latency_(latency) {}

  const Spec& spec() const override { return client_.spec(); }
  void submit(const Observation& observation, const Leftover* leftover) noexcept override {
    due_ = now + latency_;
    client_.submit(observation, leftover);
  }
  bool is_reading() const noexcept override { return client_.is_reading(); }
  const Answer* poll() noexcept override {
    if (now + 1e-9 < due_) return nullptr;
    client_.wait();
    return client_.poll();
  }
  void wait() noexcept override { now = std::max(now, due_), client_.wait(); }
  void abandon() noexcept override { client_.abandon(); }

  double now = 0;

 private:
  Client& client_;
  double latency_, due_ = 0;
};

/// Asks for a frame. Returns its width and height; its RGB bytes go to `pixels`.
std::pair<int, int> read_frame(std::string& pixels) {
  constexpr int kMost = 8192;
  std::cout << "look" << std::endl;
  std::string line;
  std::getline(std::cin, line);
  std::istringstream size(line);
  int width = 0, height = 0;
  size >> width >> height;
  if (std::min(width, height) <= 0 || std::max(width, height) > kMost)
    throw Error("usage", "frame", "WIDTH HEIGHT, of at most " + std::to_string(kMost), line);
  pixels.resize(static_cast<std::size_t>(width) * static_cast<std::size_t>(height) * 3);
  if (!std::cin.read(pixels.data(), static_cast<std::streamsize>(pixels.size())))
    throw Error("usage", "frame", std::to_string(pixels.size()) + " bytes", std::to_string(std::cin.gcount()));
  return {width, height};
}

const char* name_of(const Action& action) {
  if (action.problem != nullptr) throw Error(action.problem->code, "act", "a chunk", action.problem->message);
  return action.state == ActionState::command ? "command" : action.state == ActionState::held ? "held" : "none";
}

void run(char** argv) {
  const std::string view = argv[2], state = argv[3], text = argv[4], mode = argv[5];
  if (mode != "sync" && mode != "async") throw Error("usage", "mode", "sync or async", mode);
  double latency = 0;
  std::istringstream given(argv[6]);
  if (!(given >> latency) || !given.eof() || latency < 0) throw Error("usage", "latency", "seconds", argv[6]);
  Client client(argv[1]);
  LatePolicy policy(client, latency);
  LoopOptions options;
  options.mode = mode == "sync" ? Mode::sync : Mode::async;
  options.blend = Blend::linear(4), options.late = Late::hold, options.on_note = OnNote::ignore;
  options.clock = [&] { return policy.now; };
  ChunkLoop loop(policy, options);
  std::vector<float> joints;
  std::string pixels;
  std::optional<Error> refused;  // of a frame: `step` must not be left by an exception
  const auto look = [&](Observation& observation) {
    observation.states = {{state, joints}}, observation.text = text, observation.seed = 0;
    try {
      const auto [width, height] = read_frame(pixels);
      observation.frames = {{view, width, height, std::as_bytes(std::span(pixels))}};
    } catch (const Error& error) {
      refused = error;
    }
  };
  for (std::string line; std::getline(std::cin, line);) {
    if (line == "reset") {
      loop.reset();
      continue;
    }
    std::istringstream fields(line);
    std::string word;
    double seconds = 0;
    fields >> word >> seconds;
    if (word != "step" || !fields) throw Error("usage", "line", "step SECONDS state...", line);
    policy.now = std::max(policy.now, seconds);
    joints.clear();
    for (float value; fields >> value;) joints.push_back(value);
    if (!fields.eof()) throw Error("usage", "state", "numbers", line);
    const Action action = loop.step(look);
    if (refused) throw *refused;
    std::cout << policy.now << ' ' << name_of(action);
    for (const float value : action.values) std::cout << ' ' << value;
    std::cout << std::endl;
  }
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 7) {
    std::fprintf(stderr, "error: expected simulated ADDRESS VIEW STATE TEXT sync|async LATENCY\n");
    return 2;
  }
  try {
    std::cout.precision(9);
    run(argv);
  } catch (const Error& error) {
    std::fprintf(stderr, "error: %s: %s\n", error.code.c_str(), error.what());
    return 1;
  }
}
