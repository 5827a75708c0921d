// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

namespace vla::serve {

/// The keys that clients of a published robot send, and the names that policies use for them: the first of `features`
/// that the bundle has. Colours are RGB, angles radians and grippers as in training, unless a line says otherwise.
struct Preset {
  struct Key {
    const char* key;
    int width;             // width of a state; 0: an image
    bool required;         // false: the bundle may lack it
    const char* features;  // last parts of names, separated by spaces
  };
  const char* name;
  std::span<const Key> keys;
  const char* gripper;  // the data set's convention, for people
};

/// Source: openpi, src/openpi/policies/{libero,droid,aloha}_policy.py.
inline constexpr Preset::Key kLibero[] = {
    {"observation/image", 0, true, "image base_0_rgb base agentview top"},
    {"observation/wrist_image", 0, false, "wrist_image image2 left_wrist_0_rgb wrist"},
    {"observation/state", 8, true, "state"},
};
inline constexpr Preset::Key kDroid[] = {
    {"observation/exterior_image_1_left", 0, true, "exterior_image_1_left exterior_1_left base_0_rgb base"},
    {"observation/wrist_image_left", 0, true, "wrist_image_left wrist_left left_wrist_0_rgb wrist"},
    {"observation/joint_position", 7, true, "joint_position state"},
    {"observation/gripper_position", 1, true, "gripper_position state"},
};
inline constexpr Preset::Key kAloha[] = {
    {"images/cam_high", 0, true, "cam_high base_0_rgb top"},
    {"images/cam_low", 0, false, "cam_low"},
    {"images/cam_left_wrist", 0, false, "cam_left_wrist left_wrist_0_rgb"},
    {"images/cam_right_wrist", 0, false, "cam_right_wrist right_wrist_0_rgb"},
    {"state", 14, true, "state"},
};
inline constexpr Preset kPresets[] = {
    {"libero", kLibero, "actions -1 open to 1 closed"},
    {"droid", kDroid, "0 open to 1 closed"},
    {"aloha", kAloha, "0 closed to 1 open"},
};

}  // namespace vla::serve
