// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <fmt/format.h>

#include <cstdio>
#include <string>
#include <type_traits>
#include <utility>

#include "base/printable.h"

namespace vla::cli {

/// An argument escaped for display: texts come from bundles, recordings and servers, and must not act on a terminal.
template <class T>
decltype(auto) shown(const T& value) {
  if constexpr (std::is_convertible_v<const T&, std::string_view>) {
    return printable(value);
  } else {
    return (value);
  }
}

/// Writes text unchanged. Throws std::system_error if standard output cannot be written. Failures on standard error are
/// ignored; the exit code tells what happened.
void put(std::FILE* to, std::string_view text);

/// Formatted output to standard output and standard error. Line ends in the format stay; those in arguments are
/// escaped.
template <class... Args>
void say(std::FILE* to, fmt::format_string<decltype(shown(std::declval<const Args&>()))...> format,
         const Args&... args) {
  put(to, fmt::format(format, shown(args)...));
}

/// The same for a text of several lines that the program composed.
void say_lines(std::FILE* to, std::string_view text);

}  // namespace vla::cli
