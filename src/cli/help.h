// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <CLI/CLI.hpp>
#include <string>
#include <vector>

namespace vla::cli {

/// Help of at most 120 columns: `--threads N (0 to 512; default 0)` and a wrapped description beside it.
void format_help(CLI::App& app);

/// `vla help run` as `vla run --help`, and `vla help` as `vla --help`.
std::vector<std::string> arguments(int argc, char** argv);

/// "did you mean --threads? " where `unknown` is a few letters off what the command knows, else nothing.
std::string suggestion(const CLI::App& app, const std::string& unknown);

}  // namespace vla::cli
