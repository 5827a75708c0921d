// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "wire/vla.pb.h"

namespace vla::wire {

/// The part of a description that clients rely on, as bytes: inputs and outputs of the policy and of each robot,
/// without runtime, limits and the server's names.
std::string interface_of(v1::Description description);

}  // namespace vla::wire
