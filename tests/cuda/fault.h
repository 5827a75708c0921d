// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <stdexcept>
#include <string>

namespace vla::test::cuda {

/// What a kernel may not do, or what the emulated machine does not know.
struct Fault : std::runtime_error {
  using std::runtime_error::runtime_error;
};

}  // namespace vla::test::cuda
