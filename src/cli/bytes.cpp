// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>

#include <charconv>
#include <string_view>

#include "cli/commands.h"

namespace vla::cli {
namespace {

/// The number of bytes in a unit; 0 for an unknown unit.
double unit_size(std::string_view unit) {
  constexpr std::string_view kLetters = "BKMGT";
  if (unit.empty()) return 1;
  const std::size_t power = kLetters.find(static_cast<char>(std::toupper(static_cast<unsigned char>(unit.front()))));
  if (power == std::string_view::npos) return 0;
  const std::string_view rest = unit.substr(1);
  double size = 1;
  for (std::size_t i = 0; i < power; ++i) size *= rest == "iB" ? 1024 : 1000;
  const bool is_known = rest.empty() || (power > 0 && (rest == "B" || rest == "b" || rest == "iB"));
  return is_known ? size : 0;
}

}  // namespace

std::string read_bytes(std::string& text) {
  double number = 0;
  const char* const end = text.data() + text.size();
  const auto [unit, error] = std::from_chars(text.data(), end, number, std::chars_format::fixed);
  const double bytes = number * unit_size(std::string_view(unit, static_cast<std::size_t>(end - unit)));
  if (error != std::errc() || !(bytes >= 1) || bytes > 1e15)
    return fmt::format("expected bytes as 1.5GB, 800M or 2GiB, found {}", text);
  text = fmt::format("{:.0f}", bytes);
  return {};
}

void add_memory(CLI::App& command, std::size_t& bytes) {
  add_bytes(command, "--memory", bytes,
            "What the process may take, or with --device the policy of the GPU's memory: 1.5GB, 800MB. Matrices "
            "that do not fit stay in the file and are read in every act while others are multiplied; actions are the "
            "same to the bit. vla inspect BUNDLE --memory tells what is read and the least that does. Not given: no "
            "limit");
}

}  // namespace vla::cli
