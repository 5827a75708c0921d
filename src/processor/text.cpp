// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/text.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "processor/python_text.h"
#include "processor/unicode.h"

namespace vla {
namespace {

constexpr std::string_view kInstruction = "{instruction}";
constexpr std::string_view kNumber = "{i}";
constexpr std::string_view kState = "{state}";

}  // namespace

std::size_t occurrences(std::string_view text, std::string_view part) {
  std::size_t count = 0;
  for (std::size_t at = text.find(part); at != std::string_view::npos; at = text.find(part, at + part.size())) ++count;
  return count;
}

std::string_view strip(std::string_view text) {
  while (!text.empty()) {
    const unicode::Char c = unicode::first(text);
    if (!python::is_space(c.code_point)) break;
    text.remove_prefix(c.size);
  }
  while (!text.empty()) {
    const unicode::Char c = unicode::last(text);
    if (!python::is_space(c.code_point)) break;
    text.remove_suffix(c.size);
  }
  return text;
}

std::string replace_all(std::string_view text, std::string_view from, std::string_view to) {
  std::string out;
  std::size_t done = 0;
  for (std::size_t at = text.find(from); at != std::string_view::npos; at = text.find(from, done)) {
    out.append(text.substr(done, at - done)).append(to);
    done = at + from.size();
  }
  return out.append(text.substr(done));
}

bool is_template(std::string_view text) {
  const std::size_t n_state = occurrences(text, kState);
  return occurrences(text, kInstruction) == 1 && n_state <= 1 && occurrences(text, "{") == 1 + n_state &&
         occurrences(text, "}") == 1 + n_state;
}

bool is_numbered(std::string_view text) {
  const std::size_t n_number = occurrences(text, kNumber);
  return n_number <= 1 && occurrences(text, "{") == n_number && occurrences(text, "}") == n_number;
}

std::string view_places(const ViewsOp& op) {
  std::string out;
  for (int i = 1; i <= op.count; ++i) {
    out += replace_all(op.open, kNumber, std::to_string(i));
    for (int k = 0; k < op.repeat; ++k) out += op.token;
    out += op.close;
  }
  return out;
}

std::string fill_template(std::string_view text, std::string_view instruction, std::span<const int> words) {
  std::string out;
  while (!text.empty()) {
    if (text.starts_with(kInstruction)) {
      out.append(instruction);
      text.remove_prefix(kInstruction.size());
    } else if (text.starts_with(kState)) {
      out.append(fmt::format("{}", fmt::join(words, " ")));
      text.remove_prefix(kState.size());
    } else {
      out.push_back(text.front());
      text.remove_prefix(1);
    }
  }
  return out;
}

}  // namespace vla
