// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vla/vla.h>

#include "engine/engine.h"

namespace vla::capi {

/// A caller's observation, converted for the engine.
struct Request {
  Observation observation;
  Noise noise;
  std::optional<Leftover> leftover;
};

/// Checks the form of everything before it allocates, then decodes files and copies. The processor later checks the
/// result against the bundle. Errors: usage, unsupported, bad_observation.
Result<Request> read_observation(const vla_observation* given, const Engine& engine);

}  // namespace vla::capi
