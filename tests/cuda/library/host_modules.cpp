// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// What libvla-cuda.so of tests hands to the driver in the place of PTX.
#include "cuda/driver/modules.h"
#include "cuda/fake_driver.h"

std::vector<std::string> vla::cuda::kernel_modules() { return {vla::test::cuda::kHostModule}; }
