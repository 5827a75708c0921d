// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>

#include <algorithm>
#include <csetjmp>
#include <cstdio>  // jpeglib.h needs FILE
#include <cstdlib>
#include <cstring>
#include <new>

#include <jpeglib.h>

#include <jerror.h>

#include "processor/image_codecs.h"

namespace vla::codecs {
namespace {

/// Every scan passes over all pixels, even if it is only a few bytes of the file, so the product of scans and pixels is
/// limited. An image of 26 million pixels may have ten scans, the usual number in progressive files.
constexpr std::int64_t kMaxScans = 200, kMaxScanPixels = std::int64_t{1} << 28;

/// libjpeg reports errors through a function that must not return; `fail` uses longjmp, which runs no destructors. So
/// everything that owns memory lives here, outside the functions that a jump leaves; those functions (`guarded_*`) hold
/// only plain values.
struct JpegReader {
  jpeg_decompress_struct jpeg{};
  jpeg_error_mgr errors{};
  std::jmp_buf jump{};
  char message[JMSG_LENGTH_MAX] = {};
  std::vector<std::uint8_t> pixels;

  JpegReader() = default;
  JpegReader(const JpegReader&) = delete;
  JpegReader& operator=(const JpegReader&) = delete;
  ~JpegReader() { jpeg_destroy_decompress(&jpeg); }
};

[[noreturn]] void fail(j_common_ptr jpeg) {
  auto* reader = static_cast<JpegReader*>(jpeg->client_data);
  jpeg->err->format_message(jpeg, reader->message);
  std::longjmp(reader->jump, 1);
}

/// A warning (level -1) means that data is missing or wrong and that libjpeg replaces it.
void on_message(j_common_ptr jpeg, int level) {
  if (level < 0) fail(jpeg);
}

bool guarded_header(JpegReader& reader, Bytes file) {
  reader.jpeg.err = jpeg_std_error(&reader.errors);
  reader.errors.error_exit = fail;
  reader.errors.emit_message = on_message;
  reader.jpeg.client_data = &reader;
  if (setjmp(reader.jump) != 0) return false;
  jpeg_create_decompress(&reader.jpeg);
  jpeg_mem_src(&reader.jpeg, reinterpret_cast<const unsigned char*>(file.data()), file.size());
  jpeg_save_markers(&reader.jpeg, JPEG_APP0 + 1, 0xFFFF);
  jpeg_read_header(&reader.jpeg, TRUE);
  return true;
}

/// The facts in a file's markers.
struct Markers {
  std::int64_t width = 0, height = 0, n_scan = 0;
};

Markers read_markers(Bytes file) {
  constexpr unsigned kEnd = 0xD9, kScan = 0xDA;
  const auto byte = [&](std::size_t at) { return std::to_integer<unsigned>(file[at]); };
  Markers found;
  for (std::size_t at = 2; at + 1 < file.size();) {
    const unsigned marker = byte(at + 1);
    if (byte(at) != 0xFF || marker == 0xFF) {
      const void* next = std::memchr(file.data() + at + 1, 0xFF, file.size() - at - 1);
      if (next == nullptr) break;
      at = static_cast<std::size_t>(static_cast<const std::byte*>(next) - file.data());
      continue;
    }
    if (marker == kEnd) break;
    found.n_scan += marker == kScan ? 1 : 0;
    const bool is_frame = marker >= 0xC0 && marker <= 0xCF && marker != 0xC4 && marker != 0xC8 && marker != 0xCC;
    if (is_frame && found.height == 0 && at + 8 < file.size())
      found.height = byte(at + 5) << 8 | byte(at + 6), found.width = byte(at + 7) << 8 | byte(at + 8);
    const bool is_bare = marker <= 1 || (marker >= 0xD0 && marker <= 0xD8);  // no length follows these markers
    at += 2;
    if (!is_bare && at + 1 < file.size()) at += std::max<std::size_t>(byte(at) << 8 | byte(at + 1), 2);
  }
  return found;
}

Status check_scans(const Markers& found, const std::string& where) {
  const std::int64_t most = std::clamp<std::int64_t>(kMaxScanPixels / (found.width * found.height), 1, kMaxScans);
  if (found.n_scan <= most) return {};
  return refused(where, fmt::format("at most {} scans in a JPEG of {} x {}", most, found.width, found.height),
                 fmt::format("{} scans", found.n_scan), "save it as a baseline JPEG");
}

/// Whether the scans contain all data. libjpeg silently fills the rest with grey.
bool is_whole(const jpeg_decompress_struct& jpeg) {
  for (int c = 0; c < jpeg.num_components; ++c) {
    if (jpeg.comp_info[c].quant_table == nullptr) return false;  // no scan has this component
    const int* const missing_bits = jpeg.coef_bits != nullptr ? jpeg.coef_bits[c] : nullptr;
    if (missing_bits != nullptr && std::count(missing_bits, missing_bits + DCTSIZE2, 0) != DCTSIZE2) return false;
  }
  return true;
}

bool guarded_pixels(JpegReader& reader) {
  if (setjmp(reader.jump) != 0) return false;
  reader.jpeg.out_color_space = JCS_RGB;
  jpeg_start_decompress(&reader.jpeg);
  if (!is_whole(reader.jpeg)) {
    std::strncpy(reader.message, "one without all of its scans", sizeof reader.message - 1);
    return false;
  }
  const std::size_t row_size = static_cast<std::size_t>(reader.jpeg.output_width) * 3;
  while (reader.jpeg.output_scanline < reader.jpeg.output_height) {
    JSAMPROW row = reader.pixels.data() + reader.jpeg.output_scanline * row_size;
    jpeg_read_scanlines(&reader.jpeg, &row, 1);
  }
  jpeg_finish_decompress(&reader.jpeg);
  return true;
}

/// The text after `name` when the marker starts with it.
std::string_view payload(jpeg_saved_marker_ptr marker, std::string_view name) {
  const std::string_view data(reinterpret_cast<const char*>(marker->data), marker->data_length);
  return data.starts_with(name) ? data.substr(name.size()) : std::string_view{};
}

void read_metadata(const JpegReader& reader, Image& image) {
  using namespace std::string_view_literals;
  std::string exif;
  for (jpeg_saved_marker_ptr marker = reader.jpeg.marker_list; marker != nullptr; marker = marker->next) {
    exif += payload(marker, "Exif\0\0"sv);
    if (const auto xmp = payload(marker, "http://ns.adobe.com/xap/1.0/\0"sv); !xmp.empty()) image.xmp = xmp;
  }
  if (exif.starts_with("Exif\0\0"sv)) exif.erase(0, 6);  // some cameras write the name twice
  image.exif.assign(exif.begin(), exif.end());
}

Error corrupt(const JpegReader& reader, const std::string& where) {
  if (reader.errors.msg_code == JERR_OUT_OF_MEMORY)
    return {Code::out_of_memory, where, "", "no memory for the JPEG decoder"};
  return refused(where, "a whole JPEG image", reader.message[0] != 0 ? reader.message : "a damaged one");
}

}  // namespace

namespace {

/// The file that the encoder writes, in memory that libjpeg allocates.
struct JpegWriter {
  jpeg_compress_struct jpeg{};
  jpeg_error_mgr errors{};
  std::jmp_buf jump{};
  unsigned char* file = nullptr;
  unsigned long size = 0;

  JpegWriter() = default;
  JpegWriter(const JpegWriter&) = delete;
  JpegWriter& operator=(const JpegWriter&) = delete;
  ~JpegWriter() {
    jpeg_destroy_compress(&jpeg);
    std::free(file);
  }
};

[[noreturn]] void fail_to_write(j_common_ptr jpeg) {
  std::longjmp(static_cast<JpegWriter*>(jpeg->client_data)->jump, 1);
}

bool guarded_encode(JpegWriter& writer, const std::uint8_t* rgb, int width, int height, int quality) {
  writer.jpeg.err = jpeg_std_error(&writer.errors);
  writer.errors.error_exit = fail_to_write;
  writer.jpeg.client_data = &writer;
  if (setjmp(writer.jump) != 0) return false;
  jpeg_create_compress(&writer.jpeg);
  jpeg_mem_dest(&writer.jpeg, &writer.file, &writer.size);
  writer.jpeg.image_width = static_cast<JDIMENSION>(width);
  writer.jpeg.image_height = static_cast<JDIMENSION>(height);
  writer.jpeg.input_components = 3;
  writer.jpeg.in_color_space = JCS_RGB;
  jpeg_set_defaults(&writer.jpeg);
  jpeg_set_quality(&writer.jpeg, quality, TRUE);
  jpeg_start_compress(&writer.jpeg, TRUE);
  while (writer.jpeg.next_scanline < writer.jpeg.image_height) {
    const std::size_t row = std::size_t{writer.jpeg.next_scanline} * static_cast<std::size_t>(width) * 3;
    auto* scanline = const_cast<JSAMPROW>(rgb + row);  // libjpeg only reads it
    jpeg_write_scanlines(&writer.jpeg, &scanline, 1);
  }
  jpeg_finish_compress(&writer.jpeg);
  return true;
}

}  // namespace

std::vector<std::uint8_t> through_jpeg(const std::vector<std::uint8_t>& rgb, int width, int height, int quality) {
  JpegWriter writer;
  if (!guarded_encode(writer, rgb.data(), width, height, quality)) throw std::bad_alloc();  // nothing else can fail
  JpegReader reader;
  reader.pixels.resize(rgb.size());
  if (!guarded_header(reader, std::as_bytes(std::span(writer.file, writer.size)))) throw std::bad_alloc();
  reader.jpeg.dct_method = JDCT_IFAST;
  if (!guarded_pixels(reader)) throw std::bad_alloc();
  return std::move(reader.pixels);
}

bool is_jpeg(Bytes file) {
  constexpr std::uint8_t kStart[] = {0xFF, 0xD8, 0xFF};
  return file.size() >= sizeof kStart && std::memcmp(file.data(), kStart, sizeof kStart) == 0;
}

/// Each scan after the first costs a quarter of the first; a byte of the file costs as much as a pixel.
Result<ImageHeader> jpeg_header(Bytes file, const std::string& where, const ImageLimits& limits) {
  const Markers found = read_markers(file);
  VLA_CHECK(check_size(found.width, found.height, where, limits));
  VLA_CHECK(check_scans(found, where));
  const std::int64_t quarters = 3 + found.n_scan;
  return ImageHeader{static_cast<int>(found.width), static_cast<int>(found.height),
                     found.width * found.height * quarters / 4 + static_cast<std::int64_t>(file.size())};
}

Result<Image> decode_jpeg(Bytes file, const std::string& where, const ImageLimits& limits) {
  JpegReader reader;
  if (!guarded_header(reader, file)) return corrupt(reader, where);
  const auto width = static_cast<std::int64_t>(reader.jpeg.image_width);
  const auto height = static_cast<std::int64_t>(reader.jpeg.image_height);
  VLA_CHECK(check_size(width, height, where, limits));
  if (reader.jpeg.num_components != 1 && reader.jpeg.num_components != 3)
    return refused(where, "a grey or RGB JPEG",
                   reader.jpeg.num_components == 4 ? "a CMYK one" : "another number of channels", "convert it to RGB");
  // With arithmetic coding, missing data cannot be distinguished from zeros. No camera uses it.
  if (reader.jpeg.arith_code) return refused(where, "a JPEG in Huffman code", "arithmetic code", "save it anew");
  const Markers found = read_markers(file);
  if (found.width != width || found.height != height) return refused(where, "a whole JPEG image", "one of two sizes");
  VLA_CHECK(check_scans(found, where));
  Image image{static_cast<int>(width), static_cast<int>(height), {}, {}, {}};
  read_metadata(reader, image);  // now, because finishing frees the markers
  reader.pixels.resize(static_cast<std::size_t>(width * height) * 3);
  if (!guarded_pixels(reader)) return corrupt(reader, where);
  image.rgb = std::move(reader.pixels);
  return image;
}

}  // namespace vla::codecs
