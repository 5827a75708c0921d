// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <optional>

#include "processor/image_codecs.h"

namespace vla::codecs {
namespace {

constexpr std::uint16_t kOrientationTag = 0x0112;
constexpr std::size_t kEntrySize = 12;

/// Bounds-checked reads from a TIFF structure of either byte order.
class Tiff {
 public:
  Tiff(std::span<const std::uint8_t> bytes, bool little) : bytes_(bytes), little_(little) {}

  std::optional<std::uint32_t> read(std::uint64_t offset, int size) const {
    if (offset > bytes_.size() || bytes_.size() - offset < static_cast<std::size_t>(size)) return std::nullopt;
    std::uint32_t value = 0;
    for (int i = 0; i < size; ++i) {
      const int place = little_ ? size - 1 - i : i;
      value = value << 8 | bytes_[offset + static_cast<std::size_t>(place)];
    }
    return value;
  }
  std::size_t size() const { return bytes_.size(); }
  bool contains(std::uint64_t offset, std::uint64_t size) const {
    return offset <= bytes_.size() && size <= bytes_.size() - offset;
  }

 private:
  std::span<const std::uint8_t> bytes_;
  bool little_;
};

/// Bytes per value of a TIFF type, 0 for types that the reference skips.
std::uint64_t type_size(std::uint32_t type) {
  constexpr std::uint8_t kSizes[] = {0, 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8, 4, 0, 0, 8};
  return type < std::size(kSizes) ? kSizes[type] : 0;
}

/// The first value of an integer entry; none for other types, which the reference never takes for an orientation.
std::optional<int> integer_at(const Tiff& tiff, std::uint64_t data, std::uint32_t type) {
  const bool is_byte = type == 6;  // the reference reads type 1, the unsigned byte, as a string
  const bool is_short = type == 3 || type == 8;
  const bool is_long = type == 4 || type == 9 || type == 13;
  if (!is_byte && !is_short && !is_long) return std::nullopt;
  const auto value = tiff.read(data, is_byte ? 1 : is_short ? 2 : 4);
  return value && *value <= 8 ? static_cast<int>(*value) : 0;
}

/// Searches the first directory and tolerates the same errors as the reference: it skips values that would make the
/// total larger than the file, stops at a value outside the file, and returns the first of several orientations.
std::optional<int> search_directory(const Tiff& tiff, std::uint64_t directory) {
  const std::uint32_t count = tiff.read(directory, 2).value_or(0);
  std::uint64_t total = 0;
  for (std::uint32_t i = 0; i < count; ++i) {
    const std::uint64_t entry = directory + 2 + i * kEntrySize;
    if (!tiff.contains(entry, kEntrySize)) break;
    const std::uint32_t type = *tiff.read(entry + 2, 2);
    const std::uint64_t size = type_size(type) * *tiff.read(entry + 4, 4);
    const std::uint64_t data = size > 4 ? *tiff.read(entry + 8, 4) : entry + 8;
    if (size == 0) continue;
    if (size > 4 && (total += size) > tiff.size()) continue;
    if (!tiff.contains(data, size)) break;
    if (tiff.read(entry, 2) == kOrientationTag) return integer_at(tiff, data, type).value_or(0);
  }
  return std::nullopt;
}

std::optional<int> search_xmp(const std::string& xmp) {
  constexpr std::string_view kName = "tiff:Orientation";
  for (std::size_t at = xmp.find(kName); at != std::string::npos; at = xmp.find(kName, at + 1)) {
    std::string_view rest = std::string_view(xmp).substr(at + kName.size());
    const std::size_t skip = rest.starts_with("=\"") ? 2 : rest.starts_with(">") ? 1 : 0;
    if (skip > 0 && skip < rest.size() && rest[skip] >= '0' && rest[skip] <= '9') return rest[skip] - '0';
  }
  return std::nullopt;
}

}  // namespace

int orientation(std::span<const std::uint8_t> exif, const std::string& xmp) {
  const bool little = exif.size() >= 8 && exif[0] == 'I' && exif[1] == 'I';
  const bool big = exif.size() >= 8 && exif[0] == 'M' && exif[1] == 'M';
  const Tiff tiff(exif, little);
  std::optional<int> found;
  if ((little || big) && tiff.read(2, 2) == 42u) found = search_directory(tiff, *tiff.read(4, 4));
  if (!found) found = search_xmp(xmp);
  return found && *found >= 1 && *found <= 8 ? *found : 1;
}

}  // namespace vla::codecs
