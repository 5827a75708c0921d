// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "engine/engine.h"

namespace vla {

/// Inputs and outputs of a loaded policy, for printing and sending.
struct Description {
  struct View {
    std::string name, alias;          // the alias is empty if there is none
    bool optional;                    // whether an observation may omit the view, which declares it absent
    int width, height;                // pixels that the network sees; frames of any size are fitted
    int camera_width, camera_height;  // the checkpoint's frame size in pixels; 0 if unstated
  };
  struct Number {
    std::string name, unit;  // the unit is empty if the bundle does not state it
  };
  struct State {
    std::string name;
    std::vector<Number> numbers;
  };

  std::vector<View> views;  // in the order in which the network sees them
  int min_views;
  std::vector<State> states;
  int max_text_tokens;

  int horizon;  // rows of a chunk
  std::vector<Number> actions;
  double rate_hz;      // rows per second, 0 if the bundle does not state it
  int n_action_steps;  // rows to execute before the next observation, from the checkpoint; 0 if unstated
  int noise_rows,
      d_action_padded;        // rows and columns of the noise: the solver's start, then one part per noisy step
  std::string solver, noise;  // kinds of the solver and of the noise
  int n_step;
  double t_start;
  /// The checkpoint's settings of real-time chunking. The horizon is 0 if it states none.
  struct Rtc {
    int execution_horizon;  // rows of a chunk that are executed
    std::string schedule;
    double max_guidance;  // 0 if unstated
  } rtc;
  std::string real_time_chunking;  // how an act uses a leftover: guided, inpainted, or empty if it is refused

  std::string embodiment;  // the robot's tag, empty if the bundle is for one robot without a name
  std::string path, arch, dtype, checksum, source, revision, converter;
  std::string precision, kernels, device;
  MemoryUse memory;
};

/// `robot` is one of the engine's robots.
Description describe(const Engine& engine, const Robot& robot);

}  // namespace vla
