// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <png.h>
#include <zlib.h>

#include <algorithm>
#include <csetjmp>
#include <cstdlib>
#include <cstring>

#include "processor/image_codecs.h"

namespace vla::codecs {
namespace {

constexpr std::string_view kSignature = "\x89PNG\r\n\x1A\n";

/// libpng reports errors by longjmp, which runs no destructors. So everything that owns memory lives here, outside the
/// functions that a jump leaves, and those functions (`guarded_*`) hold only plain values.
struct PngReader {
  png_structp png = nullptr;
  png_infop info = nullptr;
  Bytes file;
  std::size_t position = 0;
  char message[128] = {};
  bool lacked_memory = false;
  std::vector<std::uint8_t> pixels;

  explicit PngReader(Bytes bytes) : file(bytes) {}
  PngReader(const PngReader&) = delete;
  PngReader& operator=(const PngReader&) = delete;
  ~PngReader() { png_destroy_read_struct(&png, &info, nullptr); }
};

void on_error(png_structp png, png_const_charp message) {
  auto* reader = static_cast<PngReader*>(png_get_error_ptr(png));
  std::strncpy(reader->message, message, sizeof reader->message - 1);
  png_longjmp(png, 1);
}

// No warning of libpng concerns the pixels.
void on_warning(png_structp, png_const_charp) {}

void on_read(png_structp png, png_bytep data, std::size_t size) {
  auto* reader = static_cast<PngReader*>(png_get_io_ptr(png));
  if (size > reader->file.size() - reader->position) png_error(png, "the file is truncated");
  std::memcpy(data, reader->file.data() + reader->position, size);
  reader->position += size;
}

/// Records a failed allocation, because libpng may report it with the message for a damaged stream.
png_voidp on_take(png_structp png, png_alloc_size_t size) {
  void* memory = std::malloc(size);
  if (memory == nullptr) static_cast<PngReader*>(png_get_mem_ptr(png))->lacked_memory = true;
  return memory;
}

void on_free(png_structp, png_voidp memory) { std::free(memory); }

bool open(PngReader& reader) {
  reader.png =
      png_create_read_struct_2(PNG_LIBPNG_VER_STRING, &reader, on_error, on_warning, &reader, on_take, on_free);
  if (reader.png == nullptr) return false;
  reader.info = png_create_info_struct(reader.png);
  return reader.info != nullptr;
}

bool guarded_header(PngReader& reader) {
  if (setjmp(png_jmpbuf(reader.png)) != 0) return false;
  png_set_read_fn(reader.png, &reader, on_read);
  png_set_user_limits(reader.png, PNG_UINT_31_MAX, PNG_UINT_31_MAX);  // `check_size` limits the size
  // Skips texts, profiles and other chunks, because libpng would unpack up to a thousand of them, of 8 MB each.
  png_set_keep_unknown_chunks(reader.png, PNG_HANDLE_CHUNK_NEVER, nullptr, -1);
  png_read_info(reader.png, reader.info);
  return true;
}

/// Requests one byte per channel: three channels, or one index into a palette.
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

/// `reader.pixels` has its memory reserved and grows as rows arrive, so that a file of a few bytes cannot cause all of
/// it to be cleared. Each pass of an interlaced file needs all rows.
bool guarded_pixels(PngReader& reader) {
  if (setjmp(png_jmpbuf(reader.png)) != 0) return false;
  const std::size_t row_size = png_get_rowbytes(reader.png, reader.info);
  const std::size_t size = row_size * png_get_image_height(reader.png, reader.info);
  for (int pass = png_set_interlace_handling(reader.png); pass > 0; --pass)
    for (std::size_t at = 0; at != size; at += row_size) {
      if (at == reader.pixels.size()) reader.pixels.resize(at + row_size);
      png_read_row(reader.png, reader.pixels.data() + at, nullptr);
    }
  png_read_end(reader.png, nullptr);
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

/// The chunks of a file that state the image's orientation.
struct Orientation {
  Bytes exif;            // the last eXIf chunk
  std::string_view xmp;  // the last XMP packet, with the fields before it in its chunk
};

/// Keeps the chunk's XMP packet, if it has one. Compressed text is not unpacked.
void read_text(std::string_view type, std::string_view content, Orientation& orientation) {
  if (type != "tEXt" && type != "iTXt") return;
  const std::string_view keyword = content.substr(0, content.find('\0'));
  if (keyword != "XML:com.adobe.xmp") return;
  content.remove_prefix(std::min(content.size(), keyword.size() + 1));
  orientation.xmp = content;
}

void drop_exif_name(std::vector<std::uint8_t>& exif) {
  constexpr std::uint8_t kName[] = {'E', 'x', 'i', 'f', 0, 0};
  for (int i = 0; i < 2 && exif.size() >= sizeof kName && std::equal(kName, kName + sizeof kName, exif.begin()); ++i)
    exif.erase(exif.begin(), exif.begin() + sizeof kName);
}

std::uint32_t number_at(Bytes file, std::size_t at) {
  std::uint32_t value = 0;
  for (std::size_t i = 0; i < 4; ++i) value = value << 8 | std::to_integer<std::uint32_t>(file[at + i]);
  return value;
}

/// Checks all chunks before libpng reads them, because libpng allocates the length that a chunk states, up to 2 GiB,
/// before it reads the chunk, and skips damaged chunks.
Status walk(Bytes file, const std::string& where, Orientation& orientation) {
  const auto damaged = [&](const char* found) { return refused(where, "a whole PNG image", found); };
  constexpr std::size_t kAround = 12;  // length, type and checksum
  for (std::size_t at = kSignature.size(); file.size() - at >= kAround;) {
    const std::size_t length = number_at(file, at);
    if (length > file.size() - at - kAround) break;
    const Bytes content = file.subspan(at + 4, length + 4);  // the checksum includes the type
    const auto checksum = crc32(0, reinterpret_cast<const Bytef*>(content.data()), static_cast<uInt>(content.size()));
    if (checksum != number_at(file, at + 8 + length)) return damaged("a chunk with another checksum");
    const std::string_view text(reinterpret_cast<const char*>(content.data()), content.size());
    if (text.starts_with("IEND")) return {};
    if (text.starts_with("eXIf")) orientation.exif = content.subspan(4);
    read_text(text.substr(0, 4), text.substr(4), orientation);
    at += length + kAround;
  }
  return damaged("a truncated one");
}

Error no_memory(const std::string& where) { return {Code::out_of_memory, where, "", "no memory for the PNG decoder"}; }

Error corrupt(const PngReader& reader, const std::string& where) {
  if (reader.lacked_memory) return no_memory(where);
  return refused(where, "a whole PNG image", reader.message[0] != 0 ? reader.message : "a damaged one");
}

}  // namespace

bool is_png(Bytes file) {
  return file.size() >= kSignature.size() && std::memcmp(file.data(), kSignature.data(), kSignature.size()) == 0;
}

Result<ImageHeader> png_header(Bytes file, const std::string& where, const ImageLimits& limits) {
  constexpr std::size_t kWidth = 16, kEnd = 33;  // places in the IHDR chunk, which comes first
  constexpr std::int64_t kWork = 3;              // per pixel, for rows with Paeth's filter
  if (file.size() < kEnd) return refused(where, "a whole PNG image", "a truncated one");
  const std::int64_t width = number_at(file, kWidth), height = number_at(file, kWidth + 4);
  VLA_CHECK(check_size(width, height, where, limits));
  return ImageHeader{static_cast<int>(width), static_cast<int>(height), kWork * width * height};
}

Result<Image> decode_png(Bytes file, const std::string& where, const ImageLimits& limits) {
  Orientation orientation;
  VLA_CHECK(walk(file, where, orientation));
  PngReader reader(file);
  if (!open(reader)) return no_memory(where);
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
  reader.pixels.reserve(row_size * height);
  if (!guarded_pixels(reader)) return corrupt(reader, where);
  if (palette && !expand_palette(reader)) return refused(where, "a whole PNG image", "a pixel beyond its palette");

  Image image{
      static_cast<int>(width), static_cast<int>(height), std::move(reader.pixels), {}, std::string(orientation.xmp)};
  for (const std::byte byte : orientation.exif) image.exif.push_back(std::to_integer<std::uint8_t>(byte));
  drop_exif_name(image.exif);
  return image;
}

}  // namespace vla::codecs

namespace vla {

Result<std::vector<std::byte>> encode_png(const Frame& frame) {
  png_image image = {};
  image.version = PNG_IMAGE_VERSION;
  image.width = static_cast<png_uint_32>(frame.width);
  image.height = static_cast<png_uint_32>(frame.height);
  image.format = PNG_FORMAT_RGB;
  const std::uint8_t* const rgb = std::get<std::vector<std::uint8_t>>(frame.rgb).data();
  png_alloc_size_t size = 0;
  std::vector<std::byte> file;
  if (png_image_write_get_memory_size(image, size, 0, rgb, 0, nullptr) != 0) {
    file.resize(size);
    if (png_image_write_to_memory(&image, file.data(), &size, 0, rgb, 0, nullptr) != 0) return file;
  }
  return Error{Code::out_of_memory, "picture", "", "no memory for the PNG encoder"};
}

}  // namespace vla
