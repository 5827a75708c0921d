// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "processor/processor.h"

namespace vla {

/// What the network gets of a frame of this view of `views()`, as a picture of 8 bits for people: the planes that
/// `Processor::encode_images` makes of it, whose numbers are scaled so that what the recipe makes of black is black,
/// and what it makes of white is white. Errors: bad_observation.
Result<Frame> picture_of(const Processor& processor, const Frame& frame, int view);

}  // namespace vla
