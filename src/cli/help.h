// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <CLI/CLI.hpp>
#include <string>
#include <vector>

namespace vla::cli {

/// Prints help of at most 120 columns: `--threads N (0 to 512; default 0)` and a wrapped description beside it.
void format_help(CLI::App& app);

/// The values of an option, e.g. `N` or `text|json`; empty for a flag.
std::string option_value(const CLI::Option& option);
/// An option's description, with its range, default and relations to other options.
std::string option_text(const CLI::Option& option);
/// The accepted words of an option that takes one of a list.
std::vector<std::string> option_choices(const CLI::Option& option);

/// Turns `vla help run` into `vla run --help`, and `vla help` into `vla --help`.
std::vector<std::string> arguments(int argc, char** argv);

/// "did you mean --threads? " if `unknown` is a few letters away from a known word, else empty.
std::string suggestion(const CLI::App& app, const std::string& unknown);

}  // namespace vla::cli
