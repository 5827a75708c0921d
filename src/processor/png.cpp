// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <png.h>
#include <zlib.h>

#include <algorithm>
#include <csetjmp>
#include <cstring>

#include "processor/image_codecs.h"

namespace vla::codecs {
namespace {

constexpr std::string_view kSignature = "\x89PNG\r\n\x1A\n";

/// libpng reports errors by longjmp, which destroys nothing. So everything that owns memory lives here, outside the
/// functions that a jump leaves, and those functions (`guarded_*`) hold only plain values.
struct PngReader {
  png_structp png = nullptr;
  png_infop info = nullptr;
  png_infop end = nullptr;
  Bytes file;
  std::size_t position = 0;
  char message[128] = {};
  std::vector<std::uint8_t> pixels;
  std::vector<png_bytep> rows;

  explicit PngReader(Bytes bytes) : file(bytes) {}
  PngReader(const PngReader&) = delete;
  PngReader& operator=(const PngReader&) = delete;
  ~PngReader() { png_destroy_read_struct(&png, &info, &end); }
};

void on_error(png_structp png, png_const_charp message) {
  auto* reader = static_cast<PngReader*>(png_get_error_ptr(png));
  std::strncpy(reader->message, message, sizeof reader->message - 1);
  png_longjmp(png, 1);
}

// Warnings are about ancillary chunks, such as a known but odd colour profile: nothing that reaches the pixels.
void on_warning(png_structp, png_const_charp) {}

void on_read(png_structp png, png_bytep data, std::size_t size) {
  auto* reader = static_cast<PngReader*>(png_get_io_ptr(png));
  if (size > reader->file.size() - reader->position) png_error(png, "the file is truncated");
  std::memcpy(data, reader->file.data() + reader->position, size);
  reader->position += size;
}

bool open(PngReader& reader) {
  reader.png = png_create_read_struct(PNG_LIBPNG_VER_STRING, &reader, on_error, on_warning);
  if (reader.png == nullptr) return false;
  reader.info = png_create_info_struct(reader.png);
  reader.end = png_create_info_struct(reader.png);
  return reader.info != nullptr && reader.end != nullptr;
}

bool guarded_header(PngReader& reader) {
  if (setjmp(png_jmpbuf(reader.png)) != 0) return false;
  png_set_read_fn(reader.png, &reader, on_read);
  png_set_user_limits(reader.png, PNG_UINT_31_MAX, PNG_UINT_31_MAX);  // `check_size` is the limit
  png_read_info(reader.png, reader.info);
  return true;
}

/// One byte per channel: three channels, or for a palette its index.
bool guarded_layout(PngReader& reader) {
  if (setjmp(png_jmpbuf(reader.png)) != 0) return false;
  const int colour = png_get_color_type(reader.png, reader.info);
  if (colour == PNG_COLOR_TYPE_PALETTE) {
    png_set_packing(reader.png);
  } else {
    if (png_get_bit_depth(reader.png, reader.info) < 8) png_set_expand_gray_1_2_4_to_8(reader.png);
    if ((colour & PNG_COLOR_MASK_COLOR) == 0) png_set_gray_to_rgb(reader.png);
    if ((colour & PNG_COLOR_MASK_ALPHA) != 0) png_set_strip_alpha(reader.png);
  }
  png_set_interlace_handling(reader.png);
  png_read_update_info(reader.png, reader.info);
  return true;
}

bool guarded_pixels(PngReader& reader) {
  if (setjmp(png_jmpbuf(reader.png)) != 0) return false;
  png_read_image(reader.png, reader.rows.data());
  png_read_end(reader.png, reader.end);
  return true;
}

/// Replaces palette indices by their colours. An index without a colour is corrupt.
bool expand_palette(PngReader& reader) {
  png_colorp palette = nullptr;
  int size = 0;
  png_get_PLTE(reader.png, reader.info, &palette, &size);
  std::vector<std::uint8_t> rgb;
  rgb.reserve(reader.pixels.size() * 3);
  for (const std::uint8_t index : reader.pixels) {
    if (index >= size) return false;
    rgb.insert(rgb.end(), {palette[index].red, palette[index].green, palette[index].blue});
  }
  reader.pixels = std::move(rgb);
  return true;
}

/// "Raw profile type exif" is how ImageMagick kept EXIF before PNG had a chunk for it: three lines, then hex digits.
std::vector<std::uint8_t> from_raw_profile(std::string_view text) {
  for (int line = 0; line < 3; ++line) {
    const std::size_t end = text.find('\n');
    if (end == std::string_view::npos) return {};
    text.remove_prefix(end + 1);
  }
  std::vector<std::uint8_t> bytes;
  int high = -1;
  for (const char c : text) {
    const int digit = c >= '0' && c <= '9'   ? c - '0'
                      : c >= 'a' && c <= 'f' ? c - 'a' + 10
                      : c >= 'A' && c <= 'F' ? c - 'A' + 10
                                             : -1;
    if (digit < 0) continue;
    if (high >= 0) bytes.push_back(static_cast<std::uint8_t>(high << 4 | digit));
    high = high >= 0 ? -1 : digit;
  }
  return bytes;
}

void read_metadata(PngReader& reader, png_infop info, Picture& picture) {
  png_textp texts = nullptr;
  int count = 0;
  png_get_text(reader.png, info, &texts, &count);
  for (int i = 0; i < count; ++i) {
    const bool international = texts[i].compression > 0;
    const std::string_view text(texts[i].text, international ? texts[i].itxt_length : texts[i].text_length);
    if (std::strcmp(texts[i].key, "XML:com.adobe.xmp") == 0) picture.xmp = text;
    if (std::strcmp(texts[i].key, "Raw profile type exif") == 0 && picture.exif.empty())
      picture.exif = from_raw_profile(text);
  }
}

void drop_exif_name(std::vector<std::uint8_t>& exif) {
  constexpr std::uint8_t kName[] = {'E', 'x', 'i', 'f', 0, 0};
  for (int i = 0; i < 2 && exif.size() >= sizeof kName && std::equal(kName, kName + sizeof kName, exif.begin()); ++i)
    exif.erase(exif.begin(), exif.begin() + sizeof kName);
}

/// Walks the chunks up to the end before libpng does: it would take memory for the length that a chunk states, up to
/// 2 GiB, before it reads, and would go on without an orientation whose chunk is damaged. `exif` is the last eXIf
/// chunk.
const char* damage(Bytes file, Bytes& exif) {
  constexpr std::size_t kAround = 12;  // length, type and checksum
  const auto number = [&](std::size_t at) {
    std::uint32_t value = 0;
    for (std::size_t i = 0; i < 4; ++i) value = value << 8 | std::to_integer<std::uint32_t>(file[at + i]);
    return value;
  };
  for (std::size_t at = kSignature.size(); file.size() - at >= kAround;) {
    const std::size_t length = number(at);
    if (length > file.size() - at - kAround) break;
    const Bytes content = file.subspan(at + 4, length + 4);  // the type belongs to the checksum
    const auto checksum = crc32(0, reinterpret_cast<const Bytef*>(content.data()), static_cast<uInt>(content.size()));
    if (checksum != number(at + 8 + length)) return "a chunk with another checksum";
    if (std::memcmp(content.data(), "IEND", 4) == 0) return nullptr;
    if (std::memcmp(content.data(), "eXIf", 4) == 0) exif = content.subspan(4);
    at += length + kAround;
  }
  return "a truncated one";
}

Error corrupt(const PngReader& reader, const std::string& where) {
  return refused(where, "a whole PNG image", reader.message[0] != 0 ? reader.message : "a damaged one");
}

}  // namespace

bool is_png(Bytes file) {
  return file.size() >= kSignature.size() && std::memcmp(file.data(), kSignature.data(), kSignature.size()) == 0;
}

Result<Picture> decode_png(Bytes file, const std::string& where, const ImageLimits& limits) {
  Bytes exif;
  if (const char* found = damage(file, exif)) return refused(where, "a whole PNG image", found);
  PngReader reader(file);
  if (!open(reader)) return Error{Code::out_of_memory, where, "", "no memory for the PNG decoder"};
  if (!guarded_header(reader)) return corrupt(reader, where);

  const std::size_t width = png_get_image_width(reader.png, reader.info);
  const std::size_t height = png_get_image_height(reader.png, reader.info);
  VLA_CHECK(check_size(static_cast<std::int64_t>(width), static_cast<std::int64_t>(height), where, limits));
  if (png_get_bit_depth(reader.png, reader.info) == 16)
    return refused(where, "8 bits per channel", "a 16-bit PNG",
                   "save it with 8 bits, or as a float32 .npy array in [0, 1]");
  if (!guarded_layout(reader)) return corrupt(reader, where);

  const bool palette = png_get_color_type(reader.png, reader.info) == PNG_COLOR_TYPE_PALETTE;
  const std::size_t row_size = png_get_rowbytes(reader.png, reader.info);
  if (row_size != width * (palette ? 1 : 3)) return corrupt(reader, where);
  reader.pixels.resize(row_size * height);
  for (std::size_t y = 0; y < height; ++y) reader.rows.push_back(reader.pixels.data() + y * row_size);
  if (!guarded_pixels(reader)) return corrupt(reader, where);
  if (palette && !expand_palette(reader)) return refused(where, "a whole PNG image", "a pixel beyond its palette");

  Picture picture{static_cast<int>(width), static_cast<int>(height), std::move(reader.pixels), {}, {}};
  for (const std::byte byte : exif) picture.exif.push_back(std::to_integer<std::uint8_t>(byte));
  read_metadata(reader, reader.info, picture);
  read_metadata(reader, reader.end, picture);
  drop_exif_name(picture.exif);
  return picture;
}

}  // namespace vla::codecs
