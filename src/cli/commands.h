// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <CLI/CLI.hpp>
#include <functional>

#include "base/result.h"

namespace vla::cli {

/// Of --kernels, wherever a policy is loaded.
constexpr const char* kKernelsHelp =
    "ggml, avx2, avx512, avx512_bf16, amx, or float32: the best that does not round to bf16; not given: the best for "
    "the bundle's "
    "dtype, which multiplies bf16 (by avx512_bf16 or amx) if the bundle is stored as bf16";

/// Of --device, wherever a policy is loaded.
constexpr const char* kDeviceHelp =
    "cpu, or vulkan[:N] or cuda[:N] where vla inspect --devices lists it; not given: cpu. Nothing takes the place of a "
    "device that is absent";

/// Of --embodiment, wherever a policy is loaded.
constexpr const char* kEmbodimentHelp =
    "The robot, by its tag, where the bundle is for several; a wrong one is answered with the list";

/// Of --strict-state, wherever observations come in.
constexpr const char* kStrictStateHelp =
    "Refuse a state that is far beyond what the policy has seen, instead of answering with a note";

/// Adds one subcommand. What it returns is run after parsing; its Status becomes the exit code (base/result.h).
using Command = std::function<Status()>;

Command add_run(CLI::App& app);
Command add_inspect(CLI::App& app);
Command add_compare(CLI::App& app);
Command add_serve(CLI::App& app);
Command add_keygen(CLI::App& app);
Command add_bench(CLI::App& app);
Command add_replay(CLI::App& app);

}  // namespace vla::cli
