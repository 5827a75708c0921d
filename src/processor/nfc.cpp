// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/nfc.h"

#include <utf8proc.h>

#include <algorithm>
#include <vector>

#include "processor/unicode.h"

namespace vla {
namespace {

constexpr int kMaxParts = 4;  // most code points that one code point decomposes to

/// Length of the prefix whose characters take part in normalization (or do not, by `wanted`), in bytes.
std::size_t prefix_of(std::string_view text, bool wanted) {
  std::size_t size = 0;
  while (size < text.size()) {
    const unicode::Char c = unicode::first(text.substr(size));
    if (((unicode::classes(c.code_point) & unicode::kNormal) != 0) != wanted) break;
    size += c.size;
  }
  return size;
}

using Characters = std::vector<utf8proc_int32_t>;

Characters decomposed(std::string_view text) {
  constexpr auto kDecompose = static_cast<utf8proc_option_t>(UTF8PROC_STABLE | UTF8PROC_DECOMPOSE);
  Characters characters;
  for (unicode::Char c; !text.empty(); text.remove_prefix(c.size)) {
    c = unicode::first(text);
    utf8proc_int32_t parts[kMaxParts];
    int boundary = 0;
    const utf8proc_ssize_t count =
        utf8proc_decompose_char(static_cast<utf8proc_int32_t>(c.code_point), parts, kMaxParts, kDecompose, &boundary);
    characters.insert(characters.end(), parts, parts + count);
  }
  return characters;
}

/// Canonical ordering: sorts marks between starters by their combining class. The library's own sort takes quadratic
/// time: seconds for an instruction of marks only.
void put_in_order(Characters& characters) {
  const auto mark_class = [](utf8proc_int32_t c) { return utf8proc_get_property(c)->combining_class; };
  const auto is_mark = [&](utf8proc_int32_t c) { return mark_class(c) != 0; };
  for (auto at = characters.begin(); at != characters.end();) {
    const auto first = std::find_if(at, characters.end(), is_mark);
    at = std::find_if_not(first, characters.end(), is_mark);
    std::stable_sort(first, at, [&](auto a, auto b) { return mark_class(a) < mark_class(b); });
  }
}

void compose(Characters& characters) {
  constexpr auto kCompose = static_cast<utf8proc_option_t>(UTF8PROC_STABLE | UTF8PROC_COMPOSE);
  const utf8proc_ssize_t count =
      utf8proc_normalize_utf32(characters.data(), static_cast<utf8proc_ssize_t>(characters.size()), kCompose);
  characters.resize(static_cast<std::size_t>(count));
}

/// No library function can fail here: the text is valid UTF-8 and the buffer is large enough.
void append_normal(std::string_view text, bool composed, std::string& out) {
  Characters characters = decomposed(text);
  put_in_order(characters);
  if (composed) compose(characters);
  for (const utf8proc_int32_t c : characters) unicode::append(out, static_cast<std::uint32_t>(c));
}

std::string normal(std::string_view text, bool composed) {
  std::string out;
  out.reserve(text.size());
  while (!text.empty()) {
    // A character that does not take part blocks composition and reordering across it.
    std::size_t size = prefix_of(text, false);
    out.append(text.substr(0, size));
    text.remove_prefix(size);
    size = prefix_of(text, true);
    if (size > 0) append_normal(text.substr(0, size), composed, out);
    text.remove_prefix(size);
  }
  return out;
}

}  // namespace

std::string nfc(std::string_view text) { return normal(text, true); }
std::string nfd(std::string_view text) { return normal(text, false); }

}  // namespace vla
