// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vla/vla.h>

#include "engine/engine.h"

namespace vla::capi {

/// A caller's observation in the engine's words.
struct Request {
  Observation observation;
  Noise noise;
  std::optional<Leftover> leftover;
};

/// Checks the form of everything before memory is taken for it, decodes files and copies; what the bundle makes of it
/// is the processor's to check. Errors: usage, unsupported, bad_observation.
Result<Request> read_observation(const vla_observation* given, const Engine& engine);

}  // namespace vla::capi
