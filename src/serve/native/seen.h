// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "engine/engine.h"
#include "serve/options.h"
#include "wire/vla.pb.h"

namespace vla::serve {

/// What the network of the robot that an act names gets of the act's view of this number (picture_of). It costs what an
/// act of this view alone may cost. From any thread. Errors: bad_observation, too_large.
Result<Frame> seen(const v1::Act& act, int view, const Engine& engine, std::int64_t max_pixels);

}  // namespace vla::serve
