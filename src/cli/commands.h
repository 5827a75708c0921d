// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <CLI/CLI.hpp>
#include <functional>

#include "base/result.h"

namespace vla::cli {

/// Help of --kernels, wherever a policy is loaded.
constexpr const char* kKernelsHelp =
    "ggml, portable, neon, neon_bf16, avx2, avx512, avx512_bf16, amx, or float32: the best that does not round to "
    "bf16, "
    "or bf16: the best that does, with large matrices rounded to it, or int8 or int4: the best, with large matrices "
    "quantized, faster and less exact; "
    "not given: on the CPU the best for the bundle's dtype, which multiplies bf16 (by neon_bf16, avx512_bf16 or amx) "
    "if the "
    "bundle is stored as bf16. On Vulkan float32 (not given) or bf16; on CUDA as stored (not given), float32, bf16, "
    "int8, int4, or ggml for its backend";

/// Help of --device, wherever a policy is loaded.
constexpr const char* kDeviceHelp =
    "cpu, or vulkan[:N] or cuda[:N] where vla inspect --devices lists it; not given: cpu. An absent device is an "
    "error: "
    "there is no fallback";

/// Help of --embodiment, wherever a policy is loaded.
constexpr const char* kEmbodimentHelp =
    "The robot, by its tag, where the bundle is for several; an error lists the valid ones";

/// Help of --strict-state, for each command that takes observations.
constexpr const char* kStrictStateHelp =
    "Refuse a state that is far beyond what the policy has seen, instead of answering with a note";

/// Adds an option whose value must not be empty: CLI11 would read an empty value as not given. `type`: what the help
/// calls the value.
inline CLI::Option* add_text(CLI::App& command, const char* name, std::string& value, const char* type,
                             const std::string& help) {
  const auto given = [](const std::string& text) {
    return text.empty() ? "expected a value, found empty text" : std::string();
  };
  return command.add_option(name, value, help)->type_name(type)->check(CLI::Validator(given, ""));
}

/// Replaces a size such as 1.5GB, 800M or 2GiB by its bytes in digits. Returns the problem, or empty.
std::string read_bytes(std::string& text);

/// Adds an option that takes a size in bytes.
template <class Bytes>
CLI::Option* add_bytes(CLI::App& command, const char* name, Bytes& bytes, const std::string& help) {
  return command.add_option(name, bytes, help)->type_name("BYTES")->transform(CLI::Validator(read_bytes, ""));
}

/// Adds --memory, for each command that loads a policy: the limit for the process, or on a GPU for the policy.
void add_memory(CLI::App& command, std::size_t& bytes);

/// Adds --absent, for each command that loads a policy: views that the robot does not have.
inline CLI::Option* add_absent(CLI::App& command, std::vector<std::string>& views) {
  return command
      .add_option(
          "--absent", views,
          "A view of the policy that the robot does not have, as camera3; several times. No observation may have "
          "it, and none needs to say so")
      ->type_name("VIEW")
      ->allow_extra_args(false);
}

/// Adds --limits and --on-limit, for each command that answers chunks.
CLI::Option* add_limits(CLI::App& command, std::string& file, std::string& on_limit);

/// Replaces `hub:OWNER/NAME@REVISION` by the file that vla-pull downloaded; other text names a file and stays. Returns
/// the problem, or empty.
std::string find_pulled(std::string& bundle);

inline void add_bundle(CLI::App& command, std::string& bundle, bool required) {
  command
      .add_option("BUNDLE", bundle,
                  "The policy, a .gguf file from vla-convert, or the hub:OWNER/NAME@REVISION of vla-pull")
      ->type_name("")
      ->required(required)
      ->transform(CLI::Validator([](std::string& text) { return find_pulled(text); }, ""));
}

/// A subcommand, to be run after parsing; its Status becomes the exit code (base/result.h). Each function below adds
/// one and returns it.
using Command = std::function<Status()>;

Command add_run(CLI::App& app);
Command add_inspect(CLI::App& app);
Command add_compare(CLI::App& app);
Command add_serve(CLI::App& app);
Command add_check(CLI::App& app);
Command add_keygen(CLI::App& app);
Command add_ctl(CLI::App& app);
Command add_bench(CLI::App& app);
Command add_doctor(CLI::App& app);
Command add_quantize(CLI::App& app);
Command add_manual(CLI::App& app);
Command add_replay(CLI::App& app);

}  // namespace vla::cli
