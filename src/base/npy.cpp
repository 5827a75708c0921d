// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/npy.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <array>
#include <charconv>
#include <cstring>
#include <string_view>

#include "base/file.h"

namespace vla {
namespace {

constexpr std::string_view kMagic = "\x93NUMPY";

/// Returns the header's text from the value of `key` on. The header is a Python dictionary literal that NumPy writes:
/// {'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }
std::string_view after(std::string_view header, std::string_view key) {
  const std::size_t at = header.find(key);
  if (at == std::string_view::npos) return {};
  header.remove_prefix(at + key.size());
  const std::size_t value = header.find_first_not_of(" :");
  return value == std::string_view::npos ? std::string_view() : header.substr(value);
}

/// The integers of `(2, 3)`; false where the text is anything else or the product overflows.
bool parse_shape(std::string_view text, std::vector<std::size_t>& shape, std::size_t& count) {
  if (text.empty() || text.front() != '(') return false;
  text.remove_prefix(1);
  count = 1;
  while (true) {
    text.remove_prefix(std::min(text.find_first_not_of(" ,"), text.size()));
    if (text.empty()) return false;
    if (text.front() == ')') return true;
    std::size_t dim = 0;
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), dim);
    if (error != std::errc() || __builtin_mul_overflow(count, dim, &count)) return false;
    shape.push_back(dim);
    text.remove_prefix(static_cast<std::size_t>(end - text.data()));
  }
}

template <class T>
std::vector<T> copy_values(std::span<const std::byte> data, std::size_t count) {
  std::vector<T> values(count);
  if (count > 0) std::memcpy(values.data(), data.data(), count * sizeof(T));
  return values;
}

}  // namespace

bool is_npy(std::span<const std::byte> bytes) {
  return bytes.size() >= kMagic.size() && std::memcmp(bytes.data(), kMagic.data(), kMagic.size()) == 0;
}

Result<NpyHeader> read_npy_header(std::span<const std::byte> bytes, const std::string& where) {
  const auto bad = [&](const std::string& found) {
    return Error{Code::bad_observation, where, "a .npy array", found, "save it with numpy.save"};
  };
  if (!is_npy(bytes) || bytes.size() < 12) return bad("other or too few bytes");
  const int version = static_cast<int>(bytes[6]);
  if (version < 1 || version > 3) return bad(fmt::format("format version {}", version));
  std::uint32_t length = 0;
  std::memcpy(&length, bytes.data() + 8, version == 1 ? 2 : 4);
  const std::size_t start = version == 1 ? 10 : 12;
  if (length > bytes.size() - start) return bad("a truncated header");
  const std::string_view header(reinterpret_cast<const char*>(bytes.data()) + start, length);
  NpyHeader out;
  std::string_view descr = after(header, "'descr'");
  if (!descr.starts_with('\'')) return bad("a dtype that is not plain");
  descr.remove_prefix(1);
  out.descr = descr.substr(0, descr.find('\''));
  const std::string_view order = after(header, "'fortran_order'");
  out.is_fortran_order = order.starts_with("True");
  if (!out.is_fortran_order && !order.starts_with("False")) return bad("a damaged order");
  if (!parse_shape(after(header, "'shape'"), out.shape, out.count)) return bad("a damaged shape");
  out.data_at = start + length;
  return out;
}

Result<NpyArray> parse_npy(std::span<const std::byte> bytes, const std::string& where) {
  const auto bad = [&](const std::string& found) {
    return Error{Code::bad_observation, where, "a .npy array of uint8 or float32 in C order", found,
                 "save it with numpy.save"};
  };
  VLA_TRY(NpyHeader header, read_npy_header(bytes, where));
  const bool is_float = header.descr == "<f4";
  if (!is_float && header.descr != "|u1") return bad("dtype '" + header.descr.substr(0, 40) + "'");
  if (header.is_fortran_order) return bad("Fortran order");
  const std::span<const std::byte> data = bytes.subspan(header.data_at);
  const std::size_t count = header.count, element = is_float ? 4 : 1;
  if (count > data.size() / element || data.size() != count * element)
    return bad(fmt::format("{} bytes of data for {} elements", data.size(), count));
  NpyArray array;
  array.shape = std::move(header.shape);
  if (is_float)
    array.values = copy_values<float>(data, count);
  else
    array.values = copy_values<std::uint8_t>(data, count);
  return array;
}

std::string npy_header(std::span<const std::size_t> shape) {
  std::string header = fmt::format("{{'descr': '<f4', 'fortran_order': False, 'shape': ({}{}), }}",
                                   fmt::join(shape, ", "), shape.size() == 1 ? "," : "");
  header.append(63 - (kMagic.size() + 4 + header.size()) % 64, ' ');
  header += '\n';
  const auto length = static_cast<std::uint16_t>(header.size());
  std::string bytes = std::string(kMagic).append("\x01\0", 2);
  bytes.append(reinterpret_cast<const char*>(&length), 2).append(header);
  return bytes;
}

Status write_npy(const std::string& path, std::span<const float> values, std::size_t rows, std::size_t columns) {
  std::string bytes = npy_header(std::array{rows, columns});
  bytes.append(reinterpret_cast<const char*>(values.data()), values.size_bytes());
  return write_file(path, bytes);
}

}  // namespace vla
