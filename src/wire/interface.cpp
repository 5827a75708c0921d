// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "wire/interface.h"

namespace vla::wire {
namespace {

void keep_interface(v1::Description& description) {
  description.clear_bundle();
  description.clear_runtime();
  description.clear_limits();
  description.clear_n_action_steps();  // how to run a policy, not its inputs and outputs
  description.clear_rtc();
  for (v1::ViewSpec& view : *description.mutable_views()) view.clear_camera_width(), view.clear_camera_height();
  description.clear_policy();
  description.clear_policies();
  for (v1::Description& robot : *description.mutable_embodiments()) keep_interface(robot);
}

}  // namespace

std::string interface_of(v1::Description description) {
  keep_interface(description);
  return description.SerializeAsString();
}

}  // namespace vla::wire
