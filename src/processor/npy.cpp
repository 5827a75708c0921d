// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>

#include <charconv>
#include <cstring>
#include <map>

#include "processor/image_codecs.h"

namespace vla::codecs {
namespace {

constexpr std::string_view kMagic = "\x93NUMPY";
constexpr const char* kArray = "a .npy array (height, width, 3) of uint8 or float32 in C order";

std::string_view as_text(Bytes file) { return {reinterpret_cast<const char*>(file.data()), file.size()}; }

struct Layout {
  std::string_view header;  // a Python dictionary
  std::size_t data = 0;     // offset
};

/// Versions 1 to 3 differ in the width of the header's length.
bool find_layout(Bytes file, Layout& layout) {
  if (file.size() < 10) return false;
  const int version = std::to_integer<int>(file[6]);
  if (version < 1 || version > 3) return false;
  const std::size_t width = version == 1 ? 2 : 4;
  const std::size_t start = 8 + width;
  if (file.size() < start) return false;
  std::size_t length = 0;
  for (std::size_t i = 0; i < width; ++i) length |= std::to_integer<std::size_t>(file[8 + i]) << (8 * i);
  if (length > file.size() - start) return false;
  layout = {as_text(file).substr(start, length), start + length};
  return true;
}

/// The text of a value in `{'descr': '|u1', 'fortran_order': False, 'shape': (48, 64, 3), }`, which NumPy always
/// writes in this form; empty when it is not there.
std::string_view value_of(std::string_view header, std::string_view key) {
  const std::size_t at = header.find(fmt::format("'{}': ", key));
  if (at == std::string_view::npos) return {};
  const std::string_view rest = header.substr(at + key.size() + 4);
  const std::size_t end = rest.find(rest.starts_with('(') ? ')' : ',');
  return end == std::string_view::npos ? std::string_view{} : rest.substr(0, rest[0] == '(' ? end + 1 : end);
}

bool parse_shape(std::string_view text, std::int64_t (&shape)[3]) {
  if (!text.starts_with('(')) return false;
  for (int i = 0; i < 3; ++i) {
    text.remove_prefix(1);
    while (text.starts_with(' ')) text.remove_prefix(1);
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), shape[i]);
    if (error != std::errc{}) return false;
    text.remove_prefix(static_cast<std::size_t>(end - text.data()));
    if (!text.starts_with(i < 2 ? ',' : ')')) return false;
  }
  return shape[2] == 3;
}

/// A piece of the header for a message: a hostile file may hold anything there.
std::string shown(std::string_view text) {
  std::string safe(text.substr(0, 40));
  for (char& c : safe)
    if (c < ' ' || c > '~') c = '?';
  return safe.empty() ? "none" : safe;
}

template <class T>
std::vector<T> copy_of(Bytes data) {
  std::vector<T> values(data.size() / sizeof(T));
  std::memcpy(values.data(), data.data(), data.size());
  return values;
}

}  // namespace

bool is_npy(Bytes file) { return as_text(file).starts_with(kMagic); }

Result<Frame> decode_npy(Bytes file, const std::string& where, const ImageLimits& limits) {
  Layout layout;
  if (!find_layout(file, layout)) return refused(where, kArray, "a damaged header");
  const std::string_view type = value_of(layout.header, "descr");
  const bool bytes = type == "'|u1'";
  if (!bytes && type != "'<f4'") return refused(where, kArray, "elements of type " + shown(type));
  std::int64_t shape[3] = {};
  const std::string_view shape_text = value_of(layout.header, "shape");
  if (!parse_shape(shape_text, shape)) return refused(where, kArray, "shape " + shown(shape_text));
  if (value_of(layout.header, "fortran_order") != "False") return refused(where, kArray, "Fortran order");
  VLA_CHECK(check_size(shape[1], shape[0], where, limits));

  const Bytes data = file.subspan(layout.data);
  const auto expected = static_cast<std::size_t>(shape[0] * shape[1] * 3) * (bytes ? 1 : sizeof(float));
  if (data.size() != expected)
    return refused(where, fmt::format("{} bytes of pixels", expected), std::to_string(data.size()));
  Frame frame{static_cast<int>(shape[1]), static_cast<int>(shape[0]), {}};
  if (bytes) {
    frame.rgb = copy_of<std::uint8_t>(data);
  } else {
    frame.rgb = copy_of<float>(data);
  }
  return frame;
}

}  // namespace vla::codecs
