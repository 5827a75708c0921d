// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <CLI/CLI.hpp>
#include <string>
#include <vector>

namespace vla::cli {

/// Help of at most 120 columns: `--threads N (0 to 512; default 0)` and a wrapped description beside it.
void format_help(CLI::App& app);

/// The values that an option takes, e.g. `N` or `text|json`; empty where it takes nothing.
std::string option_value(const CLI::Option& option);
/// The meaning of an option, with its range, default and relations to others.
std::string option_text(const CLI::Option& option);
/// The words that it takes, where it takes certain ones alone.
std::vector<std::string> option_choices(const CLI::Option& option);

/// `vla help run` as `vla run --help`, and `vla help` as `vla --help`.
std::vector<std::string> arguments(int argc, char** argv);

/// "did you mean --threads? " where `unknown` is a few letters off what the command knows, else nothing.
std::string suggestion(const CLI::App& app, const std::string& unknown);

}  // namespace vla::cli
