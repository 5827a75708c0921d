// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <random>
#include <string>
#include <vector>

#include "bundle/keys.h"

namespace vla::fuzz {

using Random = std::mt19937;

inline std::size_t below(Random& random, std::size_t count) { return random() % std::max<std::size_t>(count, 1); }

/// A few bytes flipped, overwritten, cut out, repeated or moved: what a fuzzer without feedback does, for compilers
/// that have none.
inline std::string damaged(std::string bytes, Random& random) {
  constexpr char kOdd[] = {0, 1, 0x7F, static_cast<char>(0x80), static_cast<char>(0xFF), '"', '{', '0'};
  for (std::size_t n = 1 + below(random, 4); n > 0 && !bytes.empty(); --n) {
    const std::size_t at = below(random, bytes.size());
    const std::size_t size = 1 + below(random, std::min<std::size_t>(bytes.size() - at, 16));
    switch (random() % 6) {
      case 0:
        bytes[at] = static_cast<char>(bytes[at] ^ 1 << random() % 8);
        break;
      case 1:
        std::fill_n(bytes.begin() + static_cast<std::ptrdiff_t>(at), size, kOdd[random() % sizeof kOdd]);
        break;
      case 2:
        bytes.erase(at, size);
        break;
      case 3:
        bytes.insert(at, bytes.substr(below(random, bytes.size()), size));
        break;
      case 4:
        bytes.resize(at);
        break;
      default:
        for (std::size_t i = 0; i < size; ++i) bytes[at + i] = static_cast<char>(random());
    }
  }
  return bytes;
}

inline double odd_number(Random& random) {
  constexpr double kOdd[] = {0, -1, 1, 1e-30, -1e-30, 1e30, -1e30, 0.5, 3e9, -1000, 1e308};
  return kOdd[random() % std::size(kOdd)];
}

inline std::int64_t odd_integer(Random& random, std::int64_t from) {
  const std::int64_t odd[] = {0, 1, 2, 3, from - 1, from + 1, 2 * from, from / 2, -1, 255, 65535, 65536, INT32_MAX};
  return odd[random() % std::size(odd)];
}

/// Another value of the same type.
inline Value odd_value(const Value& from, Random& random) {
  if (const auto* flag = std::get_if<bool>(&from)) return !*flag;
  if (const auto* integer = std::get_if<std::int64_t>(&from)) return odd_integer(random, *integer);
  if (std::holds_alternative<double>(from)) return odd_number(random);
  if (const auto* text = std::get_if<std::string>(&from)) return damaged(*text, random);
  Value to = from;
  const auto change = [&](auto& list, auto other) {
    if (list.empty() || random() % 4 == 0) return list.push_back(list.empty() ? other({}) : list.front());
    const std::size_t at = below(random, list.size());
    if (random() % 3 == 0)
      list.erase(list.begin() + static_cast<std::ptrdiff_t>(at));
    else
      list[at] = other(list[at]);
  };
  if (auto* integers = std::get_if<std::vector<std::int64_t>>(&to))
    change(*integers, [&](std::int64_t value) { return odd_integer(random, value); });
  if (auto* numbers = std::get_if<std::vector<double>>(&to))
    change(*numbers, [&](double) { return odd_number(random); });
  if (auto* texts = std::get_if<std::vector<std::string>>(&to))
    change(*texts, [&](const std::string& text) { return damaged(text, random); });
  return to;
}

/// One number, word or list of a JSON text made odd, so that what parses is met more often than what does not.
inline std::string odd_json(std::string text, Random& random) {
  std::vector<std::size_t> starts;  // of numbers
  for (std::size_t i = 1; i < text.size(); ++i)
    if (std::string("-0123456789").find(text[i]) != std::string::npos &&
        std::string(" :[,").find(text[i - 1]) != std::string::npos)
      starts.push_back(i);
  if (starts.empty() || random() % 4 == 0) return damaged(std::move(text), random);
  for (std::size_t n = 1 + below(random, 3); n > 0; --n) {
    const std::size_t at = starts[below(random, starts.size())];
    if (at >= text.size()) break;
    const std::size_t end = text.find_first_not_of("-+.0123456789eE", at);
    const std::string odd[] = {std::to_string(odd_integer(random, 7)), std::to_string(random() % 1000), "0.001", "1e9",
                               "-1"};
    text.replace(at, end - at, odd[random() % std::size(odd)]);
  }
  return text;
}

}  // namespace vla::fuzz
