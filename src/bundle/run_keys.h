// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "bundle/keys.h"

/// Optional keys that say how to run a checkpoint. They change no number of an action chunk.
namespace vla {

inline constexpr const char* kActionSteps = "action.n_action_steps";
inline constexpr const char* kCameraSizes = "observation.camera_sizes";  // width and height of each view
inline constexpr Range kCameraSide = {0, 65535};
inline constexpr const char* kRtcHorizon = "rtc.execution_horizon";
inline constexpr const char* kRtcSchedule = "rtc.schedule";
inline constexpr const char* kRtcGuidance = "rtc.max_guidance";

}  // namespace vla
