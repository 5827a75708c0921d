// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "wire/vla.pb.h"

namespace vla::wire {

/// The part of a description that a client relies on, as bytes: inputs and outputs of the policy and of each of its
/// robots, without who computes them, limits and names in the server.
std::string interface_of(v1::Description description);

}  // namespace vla::wire
